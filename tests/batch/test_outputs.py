"""What a batch writes of its pings: arrays, pictures, bags and images of a camera."""

import json
import re
import shutil
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import xarray as xr
import zarr
from rosbags.highlevel import AnyReader

import sonar_gl as sg
from sonar_gl.batch import outputs
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import begin, create_store, finalize, make_part
from sonar_gl.imaging.boxes import body_map, boxes_of
from sonar_gl.noise.reception import receiver_power
from tests.support.batch_pings import N_SMALL, pings_of
from tests.support.batches import LABELS, files_of, make_all, open_batch, write_job, write_plain_job


@pytest.mark.slow
@pytest.mark.parametrize("sonar", ["level", "upright"])
def test_xarray_reads_the_pings_of_a_simulator_within_the_stated_errors(small, requests, pings, quiet, sonar):
    data = xr.open_dataset(small / "out" / "pings.zarr", group=sonar)
    assert data.intensity.dims == ("ping", "beam", "range")
    assert dict(data.sizes) | {"ping": N_SMALL} == dict(data.sizes)
    assert np.array_equal(data.azimuth_rad, requests.sonars[sonar].azimuth_rad)
    assert np.array_equal(data.range, requests.sonars[sonar].range_m) and data.range.attrs["units"] == "m"
    n_shadowed = 0
    for number, ping in enumerate(pings[sonar]):
        stored = data.isel(ping=number)
        assert np.array_equal(stored.pose, ping.pose)
        assert float(stored.time_s) == ping.meta["time_s"]
        error = np.abs(stored.intensity.values - ping.intensity)
        assert (error <= stored.intensity.attrs["relative_error_max"] * ping.intensity).all()
        assert np.array_equal(stored.body_id, ping.body_id)
        assert np.array_equal(stored.class_id, np.array([0, 1, 2, 1])[ping.body_id])
        for name, values in (
            ("elevation_rad", ping.elevation_rad),
            ("true_range_m", ping.true_range_m),
            ("incidence_rad", ping.incidence_rad),
            ("share", ping.share),
        ):
            # half a step, and the rounding of float32
            step = stored[name].encoding["scale_factor"]
            assert np.array_equal(np.isnan(stored[name]), np.isnan(values))
            assert np.nanmax(np.abs(stored[name].values - values)) <= step / 2 * (1 + 1e-4) + 1e-6
        assert np.array_equal(stored.shadow, ping.shadow)
        n_shadowed += int(ping.shadow.sum())
        assert np.allclose(stored.body_echo, ping.body_echo[1:], rtol=1e-6)
        boxes = boxes_of(ping, 512, quiet[sonar][number])
        visible = boxes.body_id.astype(int) - 1
        assert np.array_equal(np.flatnonzero(stored.body_bins), visible)
        assert np.array_equal(stored.body_pixels[visible], boxes.pixels)
        assert np.array_equal(stored.body_bins[visible], boxes.n_bins)
        assert np.array_equal(stored.body_box[visible], np.hstack([boxes.beams, boxes.bins]))
    assert n_shadowed > 0 or sonar == "upright"
    assert (data.status == 1).all()
    assert data.attrs["noise_seed"] == requests.noise_seed(sonar) and data.attrs["seed"] == 5
    assert sg.Sonar(**json.loads(data.attrs["specification"])) == requests.sonars[sonar]
    assert sg.Acoustics(**json.loads(data.attrs["acoustics"])) == requests.acoustics
    assert not [key for key, value in data.attrs.items() if isinstance(value, dict)]  # netCDF has none
    assert data.attrs["bodies"] == ["wall", "box_1", "floor"] and data.attrs["classes"] == ["fixed", "target"]


def test_what_xarray_has_read_it_writes_again_as_it_was(small, tmp_path):
    stored = small / "out" / "pings.zarr"
    with warnings.catch_warnings():
        warnings.simplefilter("error", xr.SerializationWarning)
        xr.open_dataset(stored, group="level").to_zarr(tmp_path / "again.zarr")
    before, again = (zarr.open_group(path, mode="r") for path in (stored / "level", tmp_path / "again.zarr"))
    for name in ("intensity", "elevation_rad", "true_range_m", "incidence_rad", "share", "body_id", "shadow"):
        assert again[name].dtype == before[name].dtype and np.array_equal(again[name], before[name])


def test_a_ping_is_made_again_with_its_noise_from_what_is_stored(tmp_path):
    """With all bits of the mantissa, bit for bit."""
    path = write_plain_job(tmp_path, 2, 2, "[arrays]\nmantissa_bits = 23")
    make_all(path, tmp_path / "out")
    data = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    sonar, acoustics, noise = (
        kind(**json.loads(data.attrs[name]))
        for kind, name in ((sg.Sonar, "specification"), (sg.Acoustics, "acoustics"), (sg.Noise, "noise"))
    )
    for n in range(2):
        sampling = sg.Sampling(float(data.columns_per_beam[n]), int(data.rows[n]))
        with sg.Simulator(sg.load_scene(tmp_path / "tank.sdf"), sonar, acoustics, sampling) as simulator:
            ping = simulator.ping(
                data.pose[n].values,
                noise,
                int(data.attrs["noise_seed"]),
                ping_number=n,
                time_s=float(data.time_s[n]),
            )
        assert np.array_equal(ping.intensity, data.intensity[n])


@pytest.mark.slow
def test_a_film_that_cannot_be_made_is_refused_before_the_first_ping(tmp_path):
    """Video of MPEG-4 part 2 has no 8192 rows; a batch with all pings made could not be completed without its film."""
    more = '[pictures]\nformats = ["mp4"]\nheight = 8192'
    batch = open_batch(write_job(tmp_path, 2, LABELS + more), tmp_path / "out")
    with pytest.raises(sg.Error) as caught:
        begin(batch)
    batch.close()
    pattern = r".*job\.toml.*: pictures: the film of 'level': OpenCV cannot write an MP4 of \d+ x \d+ pixels here; .*"
    assert re.fullmatch(pattern, str(caught.value))


@pytest.mark.slow
def test_a_film_that_failed_is_made_by_the_next_try(small, tmp_path, monkeypatch):
    """As on a full disk: the batch is complete once there is room."""
    out = shutil.copytree(small / "out", tmp_path / "out")
    before = files_of(out)
    for name in ("level.mp4", "done.json"):
        (out / name).unlink()

    def full(*_):
        raise sg.Error("the disk is full")

    batch = open_batch(small / "job.toml", out)
    with monkeypatch.context() as patch:
        patch.setattr(outputs, "save_animation", full)
        with pytest.raises(sg.Error, match=r"^the disk is full$"):
            finalize(batch)
    finalize(batch)
    batch.close()
    assert files_of(out) == before


@pytest.mark.slow
def test_layers_boxes_and_masks_leave_out_what_the_noise_hides(tmp_path):
    """Beside the same batch without noise: whether a bin keeps its label follows from its echo there."""
    data, masks, noise = {}, {}, sg.Noise(self_noise=True, ambient_db=-32.0)
    for name, text in (("quiet", 'preset = "none"'), ("noisy", "self_noise = true\nambient_db = -32.0")):
        (folder := tmp_path / name).mkdir()
        path = write_plain_job(folder, 2, 2, LABELS + "[coco]\nheight = 100\n[arrays]\nmantissa_bits = 23")
        path.write_text(path.read_text().replace('preset = "physical"', text))
        make_all(path, folder / "out")
        data[name] = xr.open_dataset(folder / "out" / "pings.zarr")
        found = sorted((folder / "out" / "coco" / "level" / "masks").rglob("*.png"))
        masks[name] = [cv2.imread(str(one), cv2.IMREAD_UNCHANGED) for one in found]
    requests = BatchRequests(read_job(path))
    about = {"sonar": requests.sonars["level"], "acoustics": requests.acoustics}
    for number in range(2):
        quiet, noisy = (data[name].isel(ping=number) for name in ("quiet", "noisy"))
        arrays = quiet.intensity.values, quiet.azimuth_rad.values, quiet.range.values
        ping = sg.Ping(*arrays, **about)
        # the share is stored in steps of 1/254
        least, most = ((quiet.share.values + step / 508) * ping.intensity for step in (-1, 1))
        power, labels = receiver_power(ping, noise), noisy.body_id.values
        assert (labels[least > power] == quiet.body_id.values[least > power]).all()
        assert not labels[most < power].any() and np.mean((least <= power) & (power <= most)) < 0.01
        assert ((labels == quiet.body_id.values) | (labels == 0)).all()
        assert np.array_equal(noisy.shadow, quiet.shadow)
        assert 0 < (labels > 0).sum() < 0.9 * (quiet.body_id.values > 0).sum()
        ping = replace(ping, body_id=labels, body_echo=np.zeros(1 + len(noisy.body_bins)))
        boxes, mask = boxes_of(ping, 512), masks["noisy"][number]
        assert np.array_equal(noisy.body_bins[boxes.body_id - 1], boxes.n_bins)
        # black pixels belong to no body
        assert (mask[mask > 0] == body_map(ping, 100)[mask > 0]).all()
        assert 0 < (mask > 0).sum() < 0.9 * (masks["quiet"][number] > 0).sum()


@pytest.mark.slow
def test_the_level_of_a_job_is_that_of_its_labels(tmp_path, pings):
    """Layers, boxes and masks are those of pings with this level; by default they are what the display shows."""
    level_db = -25.0
    path = write_job(
        tmp_path, 2, LABELS.replace("[labels]", f"[labels]\nlevel_db = {level_db}") + "[coco]\nheight = 100"
    )
    make_all(path, tmp_path / "out")
    requests = BatchRequests(read_job(path))
    made, quiet = (pings_of(tmp_path, requests, level_db, with_noise) for with_noise in (True, False))
    for sonar in made:
        data = xr.open_dataset(tmp_path / "out" / "pings.zarr", group=sonar)
        for number, (ping, without) in enumerate(zip(made[sonar], quiet[sonar], strict=True)):
            stored, boxes = data.isel(ping=number), boxes_of(ping, 512, without)
            assert np.array_equal(stored.body_id, ping.body_id)
            assert 0 < (ping.body_id > 0).sum() < (pings[sonar][number].body_id > 0).sum()
            assert np.array_equal(stored.body_bins[boxes.body_id - 1], boxes.n_bins)
            mask = tmp_path / "out" / "coco" / sonar / "masks" / "00000" / f"{number:08d}.png"
            mask = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)
            bodies = body_map(ping, 100, without)
            assert (mask[mask > 0] == bodies[mask > 0]).all() and (mask > 0).any()


def test_pictures_and_npz_files_are_those_of_a_simulator(small, pings):
    for number in (0, N_SMALL - 1):
        ping = pings["upright"][number]
        name = f"upright/00000/{number:08d}"
        loaded = sg.load_npz(small / "out" / "npz" / f"{name}.npz")
        assert np.array_equal(loaded.intensity, ping.intensity)
        assert loaded.meta["ping_number"] == number
        picture = cv2.imread(str(small / "out" / "png" / f"{name}.png"))[..., ::-1]
        assert np.array_equal(picture, sg.colorize(sg.fan_image(ping, 60)))
    film = cv2.VideoCapture(str(small / "out" / "level.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == N_SMALL


def test_the_bag_holds_every_ping_in_order(small, pings):
    with AnyReader([small / "out" / "bag"]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
        assert topics["/level/projected_image"] == topics["/upright/projected_image"] == N_SMALL
        assert topics["/level/image"] == N_SMALL
        times = [t / 1e9 for c, t, _ in reader.messages() if c.topic == "/level/projected_image"]
    assert times == pytest.approx([p.meta["time_s"] for p in pings["level"]], abs=1e-9)


def test_optical_images_are_stored_with_the_pings(small, tmp_path):
    more = "[optical]\nwidth = 40\nheight = 30\nmount = [0, 0, 0, 0, -1.3, 0]\n[ros]\n"
    write_job(tmp_path, 4, more)
    make_all(tmp_path / "job.toml", tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out" / "optical" / "rgb").rglob("*.png"))
    assert names == [f"{n:08d}.png" for n in range(4)]
    depth = cv2.imread(str(tmp_path / "out/optical/depth/00000/00000000.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16 and depth.shape == (30, 40)
    with AnyReader([tmp_path / "out" / "bag"]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
        of_depth = [c for c in reader.connections if c.topic == "/camera/depth"]
        raw = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages(of_depth)]
    assert topics["/camera/image"] == topics["/camera/depth"] == topics["/camera/camera_info"] == 4
    # as depth_image_proc reads it: what is finite is a point, also 0
    metres = np.frombuffer(raw[0].tobytes(), "<f4").reshape(30, 40)
    assert np.array_equal(np.isfinite(metres), depth > 0) and not (depth > 0).all()


@pytest.mark.slow
def test_optical_images_are_rendered_on_the_device_of_the_process(tmp_path, monkeypatch):
    """As pings are; processes of a batch share several devices."""
    devices = []

    def camera(_scene, camera, device=None):
        devices.append(device)
        size = camera.height, camera.width
        return lambda *_: (np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32))

    monkeypatch.setattr(outputs, "OpticalCamera", camera)
    job = read_job(write_job(tmp_path, 2, "[optical]\nwidth = 40\nheight = 30\n"))
    batch = Batch(BatchRequests(job), Folder(tmp_path / "out"), device=0)
    begin(batch).save(batch.folder)
    create_store(batch)
    make_part(batch, 0)
    batch.close()
    assert devices == [0]  # None is the default

"""The store of a batch: where pings are in its files, whatever the size of parts and chunks."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
import zarr

import sonar_gl as sg
from sonar_gl.batch import ping_table, store
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.manifest import Manifest, check, table_name
from sonar_gl.batch.ping_table import (
    MADE,
    NOT_MADE,
    SET_ASIDE,
    PingTable,
    gather_ping_variables,
    ping_variables,
    rows_to_bytes,
)
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.schema import ArraySpec, bin_layers
from sonar_gl.batch.steps import create_store, finalize
from sonar_gl.batch.store import PingStore, SonarGroup, consolidate, create_arrays, shared_files
from tests.support.batch_pings import N_SMALL
from tests.support.batches import files_of, make_all, open_batch, write_job
from tests.support.command_line import run

N = 30
SONAR = sg.Sonar("small", 900e3, 3, 5, 40.0, 10.0, 2.0, 0.5, 8.5)
SPECS = [
    ArraySpec("intensity", "float32", (3, 5), ("beam", "range"), 0.0, {"units": "1"}),
    ArraySpec("elevation_rad", "int16", (3, 5), ("beam", "range"), -7, {}),
    ArraySpec("body_box", "int32", (2, 4), ("body", "box"), -1, {}),
]


def make_store(folder, part, n_sonars=1):
    """Create an empty store; return it and its manifest."""
    manifest = Manifest({}, "", N, part, None, {})
    groups = {f"sonar_{k}": SonarGroup(SONAR, SPECS, {"sonar": f"sonar_{k}"}) for k in range(n_sonars)}
    create_arrays(folder, manifest, groups, {"title": "any"})
    return PingStore(folder, n_sonars), manifest


def values_of(numbers):
    """Return other values for each ping."""
    random = np.random.default_rng(0)
    whole = {spec.name: (100 * random.random((N, *spec.shape))).astype(spec.dtype) for spec in SPECS}
    return {name: values[numbers] for name, values in whole.items()}


@pytest.mark.parametrize(
    ("part", "chunk"),
    [
        *((1, 1), (12, 4), (40, 8)),
        *(pytest.param(*sizes, marks=pytest.mark.slow) for sizes in ((4, 4), (8, 8), (15, 1), (30, 2))),
    ],
)
def test_every_part_is_found_where_it_was_written(tmp_path, part, chunk):
    """Parts are whole shards, and a shard holds whole chunks of up to 8 pings."""
    folder = Folder(tmp_path)
    store, manifest = make_store(folder, part)
    for number in reversed(range(manifest.n_parts)):
        numbers = manifest.numbers(number)
        names = store.write("sonar_0", numbers[0], values_of(numbers))
        assert names == [
            f"pings.zarr/intensity/c/{number}/0/0",
            f"pings.zarr/elevation_rad/c/{number}/0/0",
            f"pings.zarr/body_box/c/{number}/0/0",
        ]
        assert [folder.checksum(name) is None for name in names] == [False] * 3
    consolidate(folder)
    data = xr.open_dataset(tmp_path / "pings.zarr", mask_and_scale=False)
    for name, values in values_of(range(N)).items():
        assert np.array_equal(data[name], values)
        array = zarr.open_array(tmp_path / "pings.zarr" / name)
        assert (array.chunks[0], array.shards[0]) == (chunk, part)
    assert np.array_equal(data.azimuth_rad, SONAR.azimuth_rad) and np.array_equal(data.range, SONAR.range_m)


def test_arrays_name_their_coordinates_and_are_shuffled_as_their_numbers_pack_best(tmp_path):
    """Azimuths are of beams alone; floats by bits, whose last ones are rounded away, and labels by bytes."""
    make_store(Folder(tmp_path), 12)
    consolidate(Folder(tmp_path))
    data = xr.open_dataset(tmp_path / "pings.zarr", mask_and_scale=False)
    coordinates = {name: set(data[name].coords) for name in ("intensity", "elevation_rad", "body_box")}
    of_bins = {"azimuth_rad", "range"}
    assert coordinates == {"intensity": of_bins, "elevation_rad": of_bins, "body_box": set()}
    for spec in SPECS:
        (codec,) = zarr.open_array(tmp_path / "pings.zarr" / spec.name).compressors
        assert codec.shuffle.value == ("bitshuffle" if spec.dtype == "float32" else "shuffle")


def test_parts_of_which_nothing_differs_from_the_fill_are_files_all_the_same(tmp_path):
    """A record names them; who copies the set would otherwise not miss them."""
    folder = Folder(tmp_path)
    store, _ = make_store(folder, 12)
    fills = {spec.name: np.full((12, *spec.shape), spec.fill, spec.dtype) for spec in SPECS}
    names = store.write("sonar_0", 12, fills)
    assert len(names) == 3 and all((tmp_path / name).stat().st_size > 0 for name in names)
    for spec in SPECS:
        assert (zarr.open_array(tmp_path / "pings.zarr" / spec.name)[:] == spec.fill).all()


@pytest.mark.slow
def test_a_shard_has_the_bytes_that_zarr_gives_it_whatever_was_there(tmp_path):
    folder, by_zarr = Folder(tmp_path / "a"), Folder(tmp_path / "b")
    store, manifest = make_store(folder, 12)
    with zarr.config.set({"array.write_empty_chunks": True}):
        group = make_store(by_zarr, 12)[0].group("sonar_0")
        by_name = {name: group[name] for name in group.array_keys()}
    for numbers in (manifest.numbers(0), manifest.numbers(2)):  # the last is no whole shard
        names = store.write("sonar_0", numbers[0], values_of(numbers))
        for name, values in values_of(numbers).items():
            by_name[name][numbers[0] : numbers[-1] + 1] = values
        expected = [by_zarr.get(name) for name in names]
        assert [folder.get(name) for name in names] == expected
        for damage in (b"", expected[0][:50], bytes(len(expected[0]))):
            for name in names:
                folder.put(name, damage)
            store.write("sonar_0", numbers[0], values_of(numbers))
            assert [folder.get(name) for name in names] == expected


def test_metadata_do_not_depend_on_the_order_in_which_folders_are_listed(tmp_path):
    folder = Folder(tmp_path)
    make_store(folder, 12, n_sonars=2)
    consolidate(folder)
    text = (tmp_path / "pings.zarr" / "zarr.json").read_text()
    found = json.loads(text)
    assert set(found["consolidated_metadata"]["metadata"]) == {
        *("sonar_0", "sonar_1"),
        *(
            f"sonar_{k}/{name}"
            for k in range(2)
            for name in ("intensity", "elevation_rad", "body_box", "azimuth_rad", "range")
        ),
    }
    assert text == json.dumps(found, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


@pytest.mark.parametrize("n_sonars", [1, 2])
def test_the_files_of_no_part_are_found_without_a_look_at_those_of_parts(tmp_path, monkeypatch, n_sonars):
    """A store of many pings has a folder for each shard, and on a remote one each listing is a request."""
    folder, listed = Folder(tmp_path), []
    store, manifest = make_store(folder, 15, n_sonars)
    for sonar in (f"sonar_{k}" for k in range(n_sonars)):
        for part in range(manifest.n_parts):
            store.write(sonar, manifest.numbers(part)[0], values_of(manifest.numbers(part)))
        store.create_variable(sonar, ArraySpec("time_s", "float64", (), (), np.nan, {}), N)
        store.group(sonar)["time_s"][:] = np.arange(N)
    part_arrays = {spec.name for spec in SPECS}
    files = (path for path in (tmp_path / "pings.zarr").rglob("*") if path.is_file())
    names = [str(path.relative_to(tmp_path)) for path in files]
    expected = [name for name in names if name.endswith("zarr.json") or not part_arrays & {*name.split("/")}]
    find = folder.fs.find
    monkeypatch.setattr(folder.fs, "find", lambda path: listed.append(path) or find(path))
    assert sorted(shared_files(folder, part_arrays)) == sorted(expected)
    assert listed and not any(path.endswith(name) for path in listed for name in part_arrays)


def test_creation_repairs_what_is_damaged_and_leaves_the_rest(tmp_path):
    folder = Folder(tmp_path)
    store, _ = make_store(folder, 12)
    store.write("sonar_0", 0, values_of(range(12)))
    paths = [path for path in tmp_path.rglob("*") if path.is_file()]
    before = {path: path.read_bytes() for path in paths}
    damaged = [path for path in paths if path.name == "zarr.json" or path.parent.parent.name == "range"]
    assert len(damaged) == 7
    for path in damaged:
        path.write_bytes(path.read_bytes()[:20])
    times = {path: path.stat().st_mtime_ns for path in paths if path not in damaged}
    make_store(folder, 12)
    assert {path: path.read_bytes() for path in paths} == before
    assert {path: path.stat().st_mtime_ns for path in times} == times


@pytest.mark.parametrize(
    ("n_bodies", "n_classes", "dtypes"),
    [(65535, 255, ("uint16", "uint8")), (65536, 256, ("uint32", "uint16"))],
)
def test_the_number_of_the_last_body_and_class_fits(n_bodies, n_classes, dtypes):
    _, *layers = bin_layers(["body", "class"], SONAR, sg.Acoustics.ideal(), 5, n_bodies, n_classes)
    assert tuple(layer.dtype for layer in layers) == dtypes


@pytest.mark.parametrize(
    ("name", "field", "greatest", "step"),
    [
        (
            "range",
            "true_range_m",
            1.0009 * SONAR.range_max_m,
            1.001 * SONAR.range_max_m / 65535,
        ),  # of the last bin
        ("incidence", "incidence_rad", np.pi / 2, np.pi / 2 / 254),
        ("elevation", "elevation_rad", np.pi / 2, 1e-4),
        ("elevation", "elevation_rad", -np.pi / 2, 1e-4),
        ("share", "share", 1.0, 1 / 254),
    ],
)
def test_the_greatest_number_is_told_from_a_missing_one(name, field, greatest, step):
    (_, layer) = bin_layers([name], SONAR, sg.Acoustics.ideal(), 5, n_bodies=9, n_classes=1)
    assert layer.attributes["scale_factor"] == pytest.approx(step, rel=1e-12)
    values = np.float32([[greatest, np.nan, 0.6 * greatest]])
    found = layer.values(SimpleNamespace(**{field: values}), None, 0)
    assert found.dtype == layer.dtype and (found == layer.fill).tolist() == [[False, True, False]]
    np.testing.assert_allclose(
        found[0, ::2] * step, values[0, ::2], rtol=0, atol=step * 0.501
    )  # rounding of float32


def test_the_range_of_the_last_bin_has_a_number_in_any_water():
    """The sonar shows ranges by another speed of sound."""
    acoustics = replace(
        sg.Acoustics.ideal(), water=sg.Water(temperature_c=30.0), sonar_sound_speed_m_s=1400.0
    )
    greatest = acoustics.true_range_sonar(SONAR).range_max_m
    assert greatest > 1.05 * SONAR.range_max_m
    (_, layer) = bin_layers(["range"], SONAR, acoustics, 5, n_bodies=9, n_classes=1)
    (found,) = layer.values(SimpleNamespace(true_range_m=np.float32([greatest])), None, 0)
    assert found * layer.attributes["scale_factor"] == pytest.approx(greatest, rel=1e-4)


def test_classes_are_those_of_bodies_and_shadows_are_ones():
    _, classes, shadow = bin_layers(
        ["class", "shadow"], SONAR, sg.Acoustics.ideal(), 5, n_bodies=9, n_classes=3
    )
    ids, is_shadow = np.array([[0, 3], [1, 2]], np.uint16), np.array([[True, False], [False, False]])
    ping, class_id = SimpleNamespace(body_id=ids, shadow=is_shadow), np.array([0, 2, 3, 1], np.uint8)
    found = classes.values(ping, class_id, 5)
    assert found.tolist() == [[0, 1], [2, 3]] and found.dtype == classes.dtype
    assert shadow.values(ping, class_id, 5).tolist() == [[1, 0], [0, 0]]


def test_the_error_of_intensities_is_as_the_attributes_state():
    (layer,) = bin_layers([], SONAR, sg.Acoustics.ideal(), 5, n_bodies=9, n_classes=1)
    values = np.random.default_rng(0).uniform(1e-3, 1e3, (100, 100)).astype(np.float32)
    wrong = np.abs(layer.values(SimpleNamespace(intensity=values), None, 0) / values - 1).max()
    stated = layer.attributes["relative_error_max"]
    assert 0.95 * stated < wrong <= stated


@pytest.mark.parametrize("first", [0, 5])
def test_bins_without_a_body_have_none_in_later_scenes_either(first):
    """Bodies of the second scene are numbered from `first` on."""
    (_, layer) = bin_layers(["body"], SONAR, sg.Acoustics.ideal(), 5, n_bodies=9, n_classes=1)
    ids = np.arange(15, dtype=np.uint16).reshape(3, 5) % 4
    ping = sg.Ping(np.zeros((3, 5), np.float32), SONAR.azimuth_rad, SONAR.range_m, body_id=ids)
    assert np.array_equal(
        layer.values(ping, np.zeros(10, np.uint8), first), np.where(ids > 0, ids + first, 0)
    )


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    """The requests of a job of 22 pings in two scenes: a body moves, or is there by chance, that the other lacks."""
    folder = tmp_path_factory.mktemp("varied")
    path = write_job(folder, 11, "")
    text = (folder / "tank.sdf").read_text()
    (folder / "other.sdf").write_text(text.replace("box_1", "box_2").replace(">5.5 0 0", ">6.5 1 0"))
    vary = {
        "bodies": [
            {
                "names": ["box_*"],
                "y_m": [-0.5, 0.5],
                "roll_rad": [0.1, 0.9],
                "reflectivity": [0.2, 0.9],
                "there": 0.7,
            },
            {"names": ["wall"], "there": 0.5},
            {"names": ["floor"], "reflectivity": [0.1, 0.3]},
        ],
        "water": {"temperature_c": [2.0, 20.0], "salinity_psu": [5.0, 35.0]},
        "noise": {"ambient_db": [-80.0, -60.0], "interference_lines": [1.0, 9.0]},
    }
    changed = {"scenes": ["tank.sdf", "other.sdf"], "vary": vary}
    return BatchRequests(Job(**read_job(path).plain | changed))


def test_numbers_of_pings_are_those_that_were_entered(varied):
    """By sonar, body and scene, also of pings that were not made."""
    table = PingTable(varied)
    rows, random = np.array([table.row(request) for request in varied]), np.random.default_rng(0)
    status = table.column(rows, "status")
    assert (status == NOT_MADE).all()
    status[1], status[2:] = SET_ASIDE, MADE
    for name in ("echo", "error_estimate", "sampling"):
        for sonar in varied.sonars:
            entered = table.column(rows, (name, sonar))
            assert np.isnan(entered).all()
            entered[2:] = random.integers(1, 999, entered[2:].shape)
    known, n_still = [{body.name: body.pose for body in varied.scenes[k].bodies} for k in range(2)], 0
    for sonar, mount in varied.mounts.items():
        variables = {one.name: one for one in ping_variables(varied, table, sonar)}
        data = {name: one.values(rows).astype(one.dtype) for name, one in variables.items()}
        assert all(data[name].shape == (22, *one.shape) for name, one in variables.items())
        assert all(np.isnan(one.fill) == (one.dtype == "float64") for one in variables.values())
        about = {name: one.attributes for name, one in variables.items()}
        flags = zip(about["status"]["flag_meanings"].split(), about["status"]["flag_values"], strict=True)
        assert dict(flags) == {"not_made": NOT_MADE, "made": MADE, "set_aside": SET_ASIDE}
        assert about["error_estimate"]["long_name"] == (  # as the page on conventions says
            "estimated share of the echo in wrong bins, or a fifth of the error of a body's own echo if that is more "
            "and breaks the tolerance"
        )
        assert data["status"].tolist() == [NOT_MADE, SET_ASIDE, *[MADE] * 20]
        for name in ("echo", "error_estimate"):
            np.testing.assert_array_equal(data[name], table.column(rows, (name, sonar))[:, 0])
        columns, n_rows = table.column(rows, ("sampling", sonar)).T
        np.testing.assert_array_equal(data["columns_per_beam"], columns)
        assert variables["rows"].values(rows).tolist() == [0, 0, *n_rows[2:]]
        moved, coloured = (
            list(zip(about[name]["scenes"], about[name]["bodies"], strict=True))
            for name in ("moved_pose", "reflectivity")
        )
        both = ("wall", "floor")
        assert moved == [(scene, name) for scene in range(2) for name in (f"box_{1 + scene}", *both)]
        assert coloured == [(0, "box_1"), (0, "floor"), (1, "box_2"), (1, "floor")]
        for k, request in enumerate(varied):
            assert (data["scene"][k], data["time_s"][k]) == (request.scene, request.time_s)
            np.testing.assert_array_equal(data["pose"][k], request.vehicle_pose @ mount)
            for name in ("temperature_c", "salinity_psu"):
                assert data[f"water_{name}"][k] == getattr(request.water, name)
            for name in ("ambient_db", "interference_lines"):
                assert data[f"noise_{name}"][k] == getattr(request.noise, name)
            for at, (scene, name) in enumerate(moved):
                pose = request.bodies.get(name, known[scene][name]) if scene == request.scene else None
                expected = np.vstack([np.full((3, 4), np.nan), np.eye(4)[3]]) if pose is None else pose
                np.testing.assert_array_equal(data["moved_pose"][k, at], expected)
                n_still += scene == request.scene and name not in request.bodies
            mu = {at: request.reflectivity.get(at[1], np.nan) for at in coloured if at[0] == request.scene}
            mu = [mu.get(at, np.nan) for at in coloured]
            np.testing.assert_array_equal(data["reflectivity"][k], mu)
    assert 0 < n_still < 2 * 22


# blocks that end within a part, and one that all pings fit into
@pytest.mark.parametrize("block_pings", [4, pytest.param(50, marks=pytest.mark.slow)])
def test_numbers_of_pings_are_gathered_whatever_blocks_they_go_through(
    varied, tmp_path, monkeypatch, block_pings
):
    """From the tables of parts to the store, whose numbers a second try replaces."""
    for module in (store, ping_table):
        monkeypatch.setattr(module, "TABLE_CHUNK_PINGS", block_pings)
    monkeypatch.setattr(ping_table, "ping_variables", _poses_alone)
    folder, table, manifest = Folder(tmp_path), PingTable(varied), Manifest({}, "", 22, 3, None, {})
    rows = np.array([table.row(request) for request in varied])
    create_arrays(
        folder, manifest, {name: SonarGroup(sonar, [], {}) for name, sonar in varied.sonars.items()}, {}
    )
    for part in range(manifest.n_parts):
        folder.put(table_name(part), rows_to_bytes(rows[manifest.numbers(part)]))
    for _ in range(2):
        consolidate(folder)  # whose list of arrays hides none that comes later
        gather_ping_variables(varied, table, manifest, folder)
    for sonar, mount in varied.mounts.items():
        array = zarr.open_array(tmp_path / "pings.zarr" / sonar / "pose")
        np.testing.assert_array_equal(array[:], [request.vehicle_pose @ mount for request in varied])
        assert array.chunks == (min(block_pings, 22), 4, 4) and np.isnan(array.fill_value)


@pytest.mark.parametrize("damage", [pytest.param(b"", marks=pytest.mark.slow), b"half"])
def test_a_damaged_table_of_a_part_is_named_with_its_cure(varied, tmp_path, damage):
    folder, table, manifest = Folder(tmp_path), PingTable(varied), Manifest({}, "", 22, 22, None, {})
    groups = {name: SonarGroup(sonar, [], {}) for name, sonar in varied.sonars.items()}
    create_arrays(folder, manifest, groups, {})
    folder.put(table_name(0), damage)
    with pytest.raises(
        sg.Error, match=r"must be the table of a part .it is damaged; delete parts/0000000.json,"
    ):
        gather_ping_variables(varied, table, manifest, folder)


def _poses_alone(requests, table, sonar):
    return [one for one in ping_variables(requests, table, sonar) if one.name == "pose"]


def test_the_root_of_a_set_with_several_sonars_names_their_groups(small):
    root = xr.open_dataset(small / "out" / "pings.zarr")
    assert not root.variables and root.attrs["sonars"] == ["level", "upright"]
    for name in root.attrs["sonars"]:
        group = xr.open_dataset(small / "out" / "pings.zarr", group=name)
        assert group.attrs["sonar"] == name and group.sizes["ping"] == N_SMALL
        assert {**root.attrs, **group.attrs} == {**group.attrs, "sonars": root.attrs["sonars"]}


@pytest.mark.slow
def test_a_set_from_before_its_root_named_the_groups_is_checked_and_resumed(small, tmp_path):
    copy = shutil.copytree(small / "out", tmp_path / "copy")
    root, folder = copy / "pings.zarr" / "zarr.json", Folder(copy)
    values = json.loads(root.read_bytes())
    del values["attributes"]["sonars"]
    folder.put_json("pings.zarr/zarr.json", values)
    done = folder.get_record("done.json", "")
    done["files"]["pings.zarr/zarr.json"] = folder.checksum("pings.zarr/zarr.json")
    folder.put_record("done.json", done)
    before = files_of(copy)
    assert check(folder, nullcontext) == []
    assert run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")[0] == 0
    assert files_of(copy) == before
    for name in ("done.json", "parts/0000001.json"):
        (copy / name).unlink()
    assert run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")[0] == 0
    assert files_of(copy) == files_of(small / "out")


@pytest.mark.slow
def test_one_line_plots_a_ping_of_one_sonar(tmp_path):
    write_job(tmp_path)
    text = (tmp_path / "job.toml").read_text()
    begin, end = text.index('[[sonars]]\nname = "upright"'), text.index("[[poses]]")
    (tmp_path / "job.toml").write_text(text[:begin] + text[end:])
    make_all(tmp_path / "job.toml", tmp_path / "out")
    mesh = xr.open_dataset(tmp_path / "out" / "pings.zarr").intensity[0].plot()
    assert mesh.get_array().size == 24 * 80


@pytest.mark.slow
def test_partial_files_are_removed_from_a_store(small, tmp_path):
    """A process that is killed leaves them, while the store is created or the batch is finalized."""
    out = shutil.copytree(small / "out", tmp_path / "out")
    before = files_of(out)
    store = out / "pings.zarr"
    partial = [store / name / "zarr.1.partial" for name in ("", "level", "level/echo")]
    batch = open_batch(small / "job.toml", out)
    for step in (create_store, finalize):
        for path in partial:
            path.write_bytes(b"half")
        step(batch)
        assert not [path for path in partial if path.exists()]
    assert files_of(out) == before

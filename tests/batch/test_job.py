"""The job file: its keys, what they may hold, and how errors name them."""

import json
import re
from pathlib import Path

import pytest

import sonar_gl as sg
from sonar_gl.batch.job import LOCATION_KEYS, Job, read_job
from sonar_gl.batch.ping_table import PingTable
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.schema import Schema
from sonar_gl.core.toml_tables import Table
from tests.support.batches import BOX, write_job
from tests.support.command_line import WALL, run


def test_the_name_of_a_model_in_place_of_its_bodies_is_told_how_to_write_them(tmp_path):
    path = write_job(tmp_path, 2, "")
    link = re.search("<link.*</link>", BOX, re.DOTALL)[0]
    links = "".join(link.replace('"link"', f'"{name}"') for name in ("hull", "arm"))
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{WALL}<model name="rov">{links}</model></world></sdf>'
    )
    plain = read_job(path).plain | {"vary": {}}
    cure = "must name bodies of the scene (got 'rov'; give 'rov::*', the bodies of this model)"
    for where, changes in (
        ("without", {"without": ["rov"]}),
        ("labels.classes.robot", {"labels": {"classes": {"robot": ["rov"]}}}),
        ("vary.bodies[0].names", {"vary": {"bodies": [{"names": ["rov"], "x_m": 1.0}]}}),
    ):
        with pytest.raises(sg.Error) as why:
            requests = BatchRequests(Job(**plain | changes))
            Schema(requests)
            PingTable(requests)
        assert str(why.value) == f"{path}: {where} {cure}"


def test_names_may_have_brackets(tmp_path):
    """As those of copies of an object have."""
    path = write_job(tmp_path, 1)
    scene = (tmp_path / "tank.sdf").read_text().replace('name="box_1"', 'name="box[1]"')
    (tmp_path / "tank.sdf").write_text(scene)
    text = path.read_text().replace('["box_*"]', '["box[1]"]').replace('["box*"]', '["box[?]"]')
    path.write_text(text.replace("seed = 5", 'seed = 5\nwithout = ["floor"]').replace(', "floor"]', "]"))
    requests = BatchRequests(read_job(path))
    assert Schema(requests).class_id.tolist() == [0, 1, 2]
    assert PingTable(requests).moved == [(0, "box[1]")]
    assert [body.name for body in requests.scenes[0].only("box[1]").bodies] == ["box[1]"]


def test_files_are_those_beside_the_job_and_no_others(tmp_path, monkeypatch):
    """A file of the same name where the command runs is not taken: other processes, and a resumption, would miss it."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    path = write_job(tmp_path, 2, "")
    for name, message in (
        ("small.toml", r"sonars\[0\]: .*/small.toml: the sonar's file must exist"),
        ("tank.sdf", r"scenes\[0\]: .*/tank.sdf: there is no such file"),
    ):
        (tmp_path / name).rename(tmp_path / "here" / name)
        with pytest.raises(sg.Error, match=message) as caught:
            Schema(BatchRequests(read_job(path)))
        assert f"{tmp_path}/{name}: " in str(caught.value)
        (tmp_path / "here" / name).rename(tmp_path / name)
    Schema(BatchRequests(read_job(path)))


def test_the_page_of_batches_states_the_keys_of_a_job():
    page = (Path(__file__).parents[2] / "docs" / "batch.md").read_text()
    rows = page.partition("| key | meaning |")[2].partition("\n\n")[0]
    stated = set(
        re.findall(r"`\[*(\w+)", " ".join(row.split("|")[1] for row in rows.strip().splitlines()[1:]))
    )
    assert stated == set(Job.model_fields) - set(LOCATION_KEYS), "the table of keys in docs/batch.md"


def test_the_page_of_batches_states_the_keys_of_the_outputs():
    page = (Path(__file__).parents[2] / "docs" / "batch.md").read_text()
    section = page.partition("### Keys of the outputs")[2].partition("### ")[0]
    rows = re.findall(r"^\| `\[(\w+)\]` \| (.*) \|$", section, re.M)
    kinds = {name: field.annotation for name, field in Job.model_fields.items() if name != "vary"}
    tables = {name for name, kind in kinds.items() if isinstance(kind, type) and issubclass(kind, Table)}
    assert {name for name, _ in rows} == tables, (
        "docs/batch.md must have a row of each table of Job, and no other"
    )
    for name, keys in rows:
        settings = Job.model_fields[name].annotation.model_fields
        known = {key: field.get_default() for key, field in settings.items()}
        stated = re.findall(r"`(\w+)(?: = (.*?))?`", keys)
        assert sorted(key for key, _ in stated) == sorted(known), (
            f"the row [{name}] of docs/batch.md must state the keys of its table in sonar_gl/batch/job.py"
        )
        for key, default in stated:
            assert json.loads(default) == known[key] if default else not known[key], (name, key)


BAD = [
    ("seed = 5", "seed = -1", "seed: should be greater than or equal to 0 (got -1)"),
    ("seed = 5", "sead = 5", "the job: unknown key (got 'sead'; did you mean 'seed'"),
    ("tolerance = 0.05", "tolerane = 0.05", "(got 'tolerane'; did you mean 'tolerance'?)"),
    ("seed = 5", "where = 'x'", "the job: unknown key (got 'where'; did you mean 'water'"),
    ('preset = "physical"', 'prest = "physical"', "noise: unknown key (got 'prest'; did you mean 'preset'?)"),
    ('kind = "sector"', 'kid = "sector"', "poses[0]: unknown key (got 'kid'; did you mean 'kind'"),
    ('kind = "sector"\n', "", "poses[0]: kind must be one of trajectory, lawnmower, orbit, sector"),
    (
        "[[vary.bodies]]",
        '[[poses]]\nkind = "trajectory"\nfile = ["dive.csv"]\n[[vary.bodies]]',
        "poses[1].file: should be a valid string (got ['dive.csv'])",
    ),
    ('name = "level"', 'name = "front-left"', "sonars[0].name: should begin with a letter, A-Z or a-z"),
    ('name = "small"', 'name = "my survey"', "name: should consist of letters, digits, _, - and ."),
    ("seed = 5", "only = []", "only: should have a length of at least 1 (got []"),
    ("seed = 5", "without = ['boat']", "without must name bodies of the scene (got 'boat';"),
    ("seed = 5", "surface_z_m = 'x'", "surface_z_m: should be a valid number (got 'x')"),
    ("seed = 5", "seed = 'x'", "seed: should be a valid integer (got 'x')"),
    ("seed = 5", "ros = 'bag'", "ros: should be a table (got 'bag';"),
    ("seed = 5", "water = 8", "water: should be a table (got 8)"),
    ("[[poses]]", "[poses]", "; write [[poses]], since there may be several)"),
    ("[[vary.bodies]]", "[vary.bodies]", "; write [[vary.bodies]], since there may be several)"),
    ("n_pings = 10", "n_ping = 10", "poses[0]: unknown key (got 'n_ping'; did you mean 'n_pings'"),
    ('kind = "sector"', 'kind = "circle"', "poses[0]: kind must be one of trajectory, lawnmower"),
    ('sonar = "small.toml"\n\n', 'sonar = "p900"\n\n', "sonars[0]: unknown sonar (got 'p900'; did you mean"),
    ("mount = [0.0,", "mount = [", "sonars[1].mount: should have a length of at least 6 (got "),
    (
        "mount = [0.0, 0.0, 0.0, 1.5707963267948966, 0.0, 0.0]",
        "mount = [0, 0, 0, 0, 30, 0]",
        "sonars[1].mount: pose angles must be radians, within ±2π (got roll pitch yaw = 0 30 0; if these are degrees,",
    ),
    ("[labels]", "[optical]\nmount = [1e10, 0, 0, 0, 0, 0]\n[labels]", "optical.mount: pose must lie"),
    ("range_m = 6.5", "range_m = 8000", "sonars[1].range_m: sonar 'small':"),
    ("range_m = 6.5", "bins = 70000", "sonars[1].bins: should be less than or equal to 65536 (got 70000)"),
    ("range_m = 6.5", "range = 6.5", "sonars[1]: unknown key (got 'range'; did you mean 'range_m'"),
    ('name = "upright"', 'name = "level"', "sonars[1].name must differ from those before (got 'level')"),
    ('"physical"\ntvg', '"fysical"\ntvg', "acoustics: acoustics: unknown profile (got 'fysical'"),
    ("tvg_absorption_db_m = 0.3", "tvg = 1", "acoustics: unknown key (got 'tvg'; did you mean 'tvg_k'"),
    ("temperature_c = [2.0, 20.0]", "temperature_c = [2.0, 90.0]", "temperature_c must lie in -2..40"),
    ("tvg_absorption_db_m = 0.3", "ph = 8", "acoustics: ph describes the water"),
    ("tvg_absorption_db_m = 0.3", "taper = 'hamming'", "acoustics: taper describes the device"),
    ("tvg_absorption_db_m = 0.3", "water = {}", "acoustics: water is a table of its own"),
    ("[noise]", "[water]\ntemp_c = 8\n[noise]", "water: unknown key (got 'temp_c';"),
    ("[noise]", "[water]\nph = 20\n[noise]", "water: water: ph must lie in 7..9 (got 20;"),
    ("temperature_c", "absorption_formula", "vary.water: unknown key (got 'absorption_formula';"),
    ("temperature_c", "temp_c", "vary.water: unknown key (got 'temp_c'; did you mean 'temperature_c'"),
    ("ambient_db", "ambience_db", "vary.noise: unknown key (got 'ambience_db'; did you mean 'ambient_db'"),
    ("ambient_db", "electronic_db", "vary.noise: electronic_db describes the device"),
    ('names = ["box_*"]', 'names = ["bax*"]', "vary.bodies[0].names must name bodies"),
    ("x_m = [-0.5, 0.5]", "x_m = [0.5, -0.5]", "vary.bodies[0].x_m: should be a number, or [low, high]"),
    ("reflectivity = [0.2, 0.9]", "reflectivity = [0.2, 9]", "bodies[0].reflectivity: should lie in 0..1"),
    ("ambient_db = [-80.0, -60.0]", "median = [3, 5]", "vary.noise: median cannot vary;"),
    ("yaw_rad = [-1.0, 1.0]", "yaw_rad = 90.0", "vary.bodies[0].yaw_rad: should lie in -6.283..6.283"),
    ("yaw_rad = [-1.0, 1.0]", "yaw_rad = [-180, 180]", "vary.bodies[0].yaw_rad: should lie in"),
    ('kind = "sector"', 'kind = ["sector"]', "poses[0]: kind must be one of trajectory, lawnmower"),
    ("[labels]", "[pictures]\ndb_range = [0, -60]\n[labels]", "pictures.db_range is no key any more;"),
    ("[labels]", "[ros]\nbits = 16\n[labels]", "ros.bits is no key any more; give counts = { bits = 16 }"),
    (
        "[labels]",
        "[pictures]\ncounts = { low_db = 0, high_db = -60 }\n[labels]",
        "pictures.counts: counts: low_db must be less than high_db (got 0 and -60)",
    ),
    ("[labels]", "[pictures]\ncounts = { bits = 16 }\n[labels]", "pictures: counts of 16 bits need gray"),
    (
        "[labels]",
        '[pictures]\ncounts = { bits = 16 }\ncolormap = "gray"\nformats = ["png", "mp4"]\n[labels]',
        "without axes, since others have 8 bits (got format mp4; ",
    ),
    ('"shadow", "boxes"]', '"boxes"]\nbackground = ["floor"]', "labels: background needs the layer shadow"),
    ("[labels]", "[coco]\ncounts = { gain = 3 }\n[labels]", "coco.counts: counts: unknown key (got 'gain'"),
    ("[labels]", "[coco]\ncounts = 3\n[labels]", "coco.counts: should be a table, such as { law"),
    ("[labels]", '[pictures]\ncolormap = "jett"\n[labels]', "pictures.colormap: unknown colour map"),
    ("there = 0.8", "apart = true\none_of = true", "vary.bodies[0]: apart and one_of exclude each other"),
    ("there = 0.8", 'rests_on = "flor"', "vary.bodies[0].rests_on must name a body of each scene of"),
    (
        "there = 0.8",
        'rests_on = "floor"\n[[vary.bodies]]\nnames = ["flo*"]',
        "vary.bodies[0].rests_on must name a body that no later table names (got 'floor', which vary.bodies[1] names; "
        "give that table first)",
    ),
    ("there = 0.8", 'rests_on = "box_1"', "vary.bodies[0].rests_on must name a body that does not move"),
    ("there = 0.8", "there = 1.8", "vary.bodies[0].there: should be less than or equal to 1 (got 1.8)"),
    ('target = ["box*"]', 'target = ["box*", "wa*"]', "labels.classes.target must hold bodies of no other"),
    ('target = ["box*"]', 'target = ["bax*"]', "labels.classes.target must name bodies"),
    ('"share", "shadow"', '"share", "share"', "labels.layers: should name each layer once"),
    ('"share", "shadow"', '"share", "shade"', "labels.layers[6]: should be 'body', 'class'"),
    ('preset = "physical"', 'preset = "loud"', "noise.preset must be one of none"),
    ('scenes = ["tank.sdf"]', 'scenes = ["tonk.sdf"]', "scenes[0]: "),
    ('scenes = ["tank.sdf"]', 'scenes = "tank.sdf"', "(got 'tank.sdf'; write [\"tank.sdf\"])"),
    ('scenes = ["tank.sdf"]', "", "scenes must be given"),
    ('sonar = "small.toml"', "", "sonars[0].sonar must be given"),
    ("seed = 5", "seed = = 5", "the job file must be TOML ("),
]


@pytest.mark.parametrize(("old", "new", "sentence"), BAD, ids=[new or sentence for _, new, sentence in BAD])
def test_errors_in_a_job_name_file_table_and_key(tmp_path, old, new, sentence):
    path = write_job(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    status, out, err = run("batch", path, "--out", tmp_path / "out", "--workers", "1")
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {path}: ") and sentence in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_needs_of_outputs_are_checked_before_anything_is_made(tmp_path):
    path = write_job(tmp_path, 10, "[coco]\n")
    with pytest.raises(sg.Error, match=f"^{path}: coco needs labels .got none; add a line"):
        read_job(path)
    write_job(tmp_path, 10, '[ros]\n[[poses]]\nkind = "trajectory"\nfile = "dive.csv"\n')
    text = path.read_text()
    path.write_text(text[: text.index("[[poses]]")] + text[text.index("[[vary.bodies]]") :])
    for times, message in (
        ([0, 1, 1, 0.5, 2], r"poses\[0\]: .*: line 5, column t: times must not fall \(got 0.5 s after 1 s"),
        ([-1, 0], r"poses\[0\].file must hold times from 0 on, for a bag \(got -1 s"),
        (
            [0, 3e9],
            r"poses must end before 2147483648 s, for a bag \(got 3000000000 s; give times in seconds",
        ),
        ([2, 2, 3], None),
    ):
        lines = [f"{t},0,0,0,0,0,0" for t in times]
        (tmp_path / "dive.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *lines]))
        if message is None:
            assert len(BatchRequests(read_job(path))) == 3
        else:
            with pytest.raises(sg.Error, match=rf"^{path}: {message}"):
                BatchRequests(read_job(path))
    path.write_text(path.read_text().replace("tank.sdf", "~nobody-of-that-name/tank.sdf"))
    with pytest.raises(
        sg.Error, match=r"scenes\[0\]: .*/~nobody-of-that-name/tank.sdf: there is no such file"
    ):
        Schema(BatchRequests(read_job(path)))

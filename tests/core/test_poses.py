"""Poses, and files of them: how they are parsed, and what is refused."""

import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sonar_gl.core import poses as module
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose, pose, pose_numbers, read_poses, scales_of
from sonar_gl.scene.scene import Body
from tests.support.errors import error_of

HEADER = "t,x,y,z,roll,pitch,yaw"


@pytest.fixture
def read(tmp_path):
    """A function that reads a table of these lines; warnings are errors."""

    def read(*lines, header=HEADER, ending="\n"):
        (tmp_path / "p.csv").write_bytes(ending.join((header, *lines, "")).encode())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return read_poses(tmp_path / "p.csv")

    return read


@pytest.fixture
def message(read, tmp_path):
    """A function that returns the message about a table, after the name of the file."""

    def message(*lines, **options):
        with pytest.raises(Error) as caught:
            read(*lines, **options)
        return str(caught.value).removeprefix(f"{tmp_path / 'p.csv'}: ")

    return message


def random_rows(count):
    rng = np.random.default_rng(0)
    places, angles = rng.normal(0, 100, (count, 3)), rng.uniform(-2 * np.pi, 2 * np.pi, (count, 3))
    return np.column_stack([np.sort(rng.uniform(0, 9, count)), places, angles])


@pytest.mark.parametrize(
    "cell",
    [
        repr,
        lambda x: f" {x!r} ",
        lambda x: f'"{x!r}"',
        lambda x: f"{x!r}".replace("1", "\N{FULLWIDTH DIGIT ONE}"),
    ],
    ids=["plain", "spaces", "quotes", "digits"],
)
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_numbers_are_those_of_the_file(read, cell, ending):
    rows = random_rows(50)
    lines = [",".join(map(cell, row)) for row in rows.tolist()]
    lines[20:20] = ["", ",,,,,,", "  "]
    times_s, poses = read(*lines, ending=ending)
    np.testing.assert_array_equal(times_s, rows[:, 0])
    np.testing.assert_array_equal(poses, [pose(*row[1:]) for row in rows])


@pytest.mark.parametrize("cell", [repr, lambda x: f'"{x!r}"'], ids=["plain", "quotes"])
def test_quaternions_are_the_same_rotations(read, cell):
    rows = random_rows(60)
    rows[:20, 5] = np.pi / 2  # straight down, where roll and yaw have the same axis
    wanted = np.array([pose(*row[1:]) for row in rows])
    quaternions = Rotation.from_matrix(wanted[:, :3, :3]).as_quat()
    quaternions[::2] *= -1
    quaternions[::3] *= 1.009  # rounded
    table = np.column_stack([rows[:, :4], quaternions])[:, [7, 0, 1, 2, 3, 4, 5, 6]]
    lines = [",".join(map(cell, row)) for row in table.tolist()]
    times_s, poses = read(*lines, header="qw,t,x,y,z,qx,qy,qz")
    np.testing.assert_array_equal(times_s, rows[:, 0])
    np.testing.assert_array_equal(poses[:, :3, 3], rows[:, 1:4])
    np.testing.assert_allclose(poses, wanted, rtol=0, atol=2e-15)
    for one in poses:
        check_pose(one)


def test_angles_count_where_a_file_has_both(read):
    _, (one,) = read("0,1,2,3,0,0,0.5,9,9,9,9", header=f"{HEADER},qx,qy,qz,qw")
    np.testing.assert_array_equal(one, pose(1, 2, 3, yaw=0.5))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ([np.array([1, 2, 3])], "pose takes six numbers, x y z roll pitch yaw (got x = array([1, 2, 3]);"),
        ([0, [[1], [2, 3]]], "pose takes six numbers, x y z roll pitch yaw (got y = [[1], [2, 3]];"),
        ([0, 0, 0, 0, 0, [0.5]], "pose takes six numbers, x y z roll pitch yaw (got yaw = [0.5];"),
        (["1", 2], "pose x y z roll pitch yaw must be an array of numbers"),
        ([1j], "pose x y z roll pitch yaw must be an array of numbers"),
    ],
)
def test_pose_of_what_is_not_six_numbers(numbers, message):
    assert error_of(pose, *numbers).startswith(message)


def test_a_pose_that_rounding_has_bent():
    turned = pose(yaw=0.3)
    for factor, advice in (
        (1 + 2e-5, "if it is a product of many poses, or float32, "),
        (1.01, "scale the mesh"),
    ):
        bent = turned * [[factor, factor, factor, 1]]
        assert f"(its 3x3 part scales, shears or reflects; {advice}" in error_of(check_pose, bent)


@pytest.mark.parametrize("odd", ["", '"0",0,0,0,0,0,0'], ids=["plain", "quotes"])
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("9,1,2,3,4,5", "line 33: must have 7 cells, as the header has (got 6)"),
        ("9,1,2,3,4,5,6,7", "line 33: must have 7 cells, as the header has (got 8)"),
        ("9,1,2,up,0,0,0", "line 33, column z: must be a finite number (got 'up')"),
        ("9,1,2,inf,0,0,0", "line 33, column z: must be a finite number (got 'inf')"),
        ("9,1,2,1e999,0,0,0", "line 33, column z: must be a finite number (got '1e999')"),
        ("1e11,0,0,0,0,0,0", "line 33, column t: must lie in -1e+10..1e+10 (got 1e+11; give seconds)"),
        ("40,1,2e9,3,0,0,0", "line 33: x y z must lie within 1e+09 m of the origin (got 1 2e+09 3;"),
        ("4.5,0,0,0,0,0,0", "line 33, column t: times must not fall (got 4.5 s after 30 s; sort the rows)"),
        ("40,0,0,0,0,0,90", "line 33: pose angles must be radians, within ±2π or unwrapped"),
    ],
)
def test_the_first_mistake_is_named_by_its_line(message, odd, line, words):
    lines = [odd, *(f"{t},0,0,0,0,0,0" for t in range(1, 31)), line, "50,what,0,0,0,0,0", "1,0,0,0,0,0,99"]
    assert message(*lines).startswith(words)


def test_times_may_be_equal(read):
    assert read("1,0,0,0,0,0,0", "1,1,0,0,0,0,0")[0].tolist() == [1.0, 1.0]


COLUMNS = f"the first line must name the columns {HEADER}, or qx,qy,qz,qw in place of the angles"


@pytest.mark.parametrize(
    ("header", "words"),
    [
        *(
            (header, f"must hold at least one pose, under the header {HEADER} (got none)")
            for header in ("", HEADER)
        ),
        ("t,x,y,z,roll,pitch", f"line 1: column yaw is not there; {COLUMNS} (got 't,x,y,z,roll,pitch')"),
        (
            "t,x,x,y,z,roll,pitch,yaw",
            f"line 1: column x is more than once; {COLUMNS} (got 't,x,x,y,z,roll,pitch,yaw')",
        ),
        *(
            (
                HEADER.replace(",", mark),
                f"line 1: column t is not there; {COLUMNS} (got {HEADER.replace(',', mark)!r}; separate columns by "
                "commas)",
            )
            for mark in (";", "\t", " ", "; ")
        ),
        ("0,0,0,0,0,0,0", f"line 1: column t is not there; {COLUMNS} (got '0,0,0,0,0,0,0')"),
        ("t,x,y,z,qx,qy,qz,roll", "line 1: column qw is not there;"),
    ],
)
def test_a_first_line_that_names_no_poses_is_refused(message, header, words):
    assert message(header=header).startswith(words)


def test_a_mistake_is_named_by_its_line_also_behind_empty_ones(message):
    assert message("0,0,0,0,0,0,0", "", "1,2,3") == "line 4: must have 7 cells, as the header has (got 3)"
    assert message(",0,0,0,0,0,0") == "line 2, column t: must be a finite number (got '')"


def test_files_of_poses_that_cannot_be_read(tmp_path):
    path = tmp_path / "p.csv"
    for content, words in (
        (None, "the file of poses must be readable (no such file or directory)"),
        (b"t,x\xff\n", "the file of poses must be text in UTF-8 (got byte 0xff; save it as UTF-8)"),
        (HEADER.encode("utf-16"), "the file of poses must be text in UTF-8 (got UTF-16; save it as UTF-8)"),
    ):
        if content is not None:
            path.write_bytes(content)
        assert error_of(read_poses, path) == f"{path}: {words}"
    assert error_of(read_poses, tmp_path) == f"{tmp_path}: must be a file (got a folder)"


def test_columns_go_by_their_names(tmp_path):
    path = tmp_path / "p.csv"
    path.write_bytes("\ufeffyaw, pitch,roll,z,y,x,note,t\r\n0.6,0.5,0.4,3,2,1,up,9\r\n\r\n".encode())
    times_s, poses = read_poses(path)
    np.testing.assert_array_equal(times_s, [9.0])
    np.testing.assert_array_equal(poses, [pose(1, 2, 3, 0.4, 0.5, 0.6)])


@pytest.mark.parametrize("column", [0, 1, 2])
def test_unwrapped_angles_are_those_wrapped(tmp_path, column):
    angles = np.zeros((40, 3))
    angles[:, column] = -3.1 * np.arange(40)
    path = tmp_path / "p.csv"
    path.write_text(
        "\n".join([HEADER, *(f"{k},0,0,0,{r},{p},{y}" for k, (r, p, y) in enumerate(angles.tolist()))])
    )
    with pytest.warns(UserWarning) as caught:
        _, poses = read_poses(path)
    assert [str(w.message) for w in caught] == [
        f"{path}: line 5: angles go beyond ±2π in small steps, and are taken as unwrapped radians (if they are "
        "degrees, multiply by π/180)"
    ]
    wrapped = np.remainder(angles + np.pi, 2 * np.pi) - np.pi
    # 120 radians are rounded to 1e-14
    np.testing.assert_allclose(poses, [pose(0, 0, 0, *row) for row in wrapped], rtol=0, atol=5e-14)


@pytest.mark.parametrize(
    "yaws",
    [(7.0, 7.1), (0.0, 6.2, 9.4), (0.0, 6.2, 7.0, 4.0, 7.2), (6.0, 9.0, -9.0)],
    ids=["first", "jump by 3.2", "jump back", "jump to the other side"],
)
def test_angles_beyond_a_turn_that_are_no_steps_are_refused(message, yaws):
    text = message(*(f"{k},0,0,0,0,0,{yaw}" for k, yaw in enumerate(yaws)))
    assert "pose angles must be radians, within ±2π or unwrapped" in text


def test_angles_of_too_many_turns_are_refused(message, monkeypatch):
    monkeypatch.setattr(module, "MAX_UNWRAPPED_RAD", 20.0)
    text = message(*(f"{k},0,0,0,0,0,{3 * k}" for k in range(10)))
    assert text.startswith("line 9: pose angles must be radians") and "yaw = 0 0 21;" in text


def test_the_scale_of_rotations_is_exactly_one_and_that_of_others_theirs():
    """Also of rotations as float32 holds them, whose columns are not of length 1 to the last bit of float64."""
    rotations = Rotation.random(200, random_state=1).as_matrix()
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, :3] = rotations.astype(np.float32)
    assert ((poses[:, :3, 0] ** 2).sum(axis=1) != 1).any()
    assert (scales_of(poses) == 1).all()
    for scale in (1e-3, 0.999, 1.001, 1e3):
        poses[:, :3, :3] = scale * rotations
        np.testing.assert_allclose(scales_of(poses), scale, rtol=1e-15 * 4)


def test_only_rotations_and_translations_are_poses():
    turned = pose(1, 2, 3, 0.1, -0.2, 0.3)
    check_pose(turned)
    wrong = [turned @ np.diag([1.0, 1.0, -1.0, 1.0])]
    for one, other in ((0, 1), (0, 2), (1, 2)):  # rows of length 1 that are not at right angles
        sheared = np.eye(4)
        sheared[other, [one, other]] = 0.6, 0.8
        wrong.append(sheared)
    for matrix in wrong:
        with pytest.raises(Error, match="its 3x3 part scales, shears or reflects; scale the mesh instead"):
            check_pose(matrix)
    turned[3, 3] = 2.0
    with pytest.raises(Error, match=r"must have the last row 0 0 0 1 \(got \[0\.0, 0\.0, 0\.0, 2\.0\]\)"):
        check_pose(turned)


@pytest.mark.parametrize(
    ("given", "got"),
    [
        (((0, 0, 0), (0, 0, 0, 1)), "a tuple of parts of 3 and 4 numbers"),
        ([np.zeros(3), np.array([0.0, 0, 0, 1])], "a list of parts of 3 and 4 numbers"),
    ],
)
def test_a_position_and_a_quaternion_are_no_pose(given, got):
    assert error_of(check_pose, given, "poses[2]") == (
        f"poses[2] must have shape (4, 4) (got {got}; of a position and a quaternion, fill np.eye(4): [:3, :3] with "
        "scipy.spatial.transform.Rotation.from_quat(xyzw).as_matrix(), and [:3, 3] with the position)"
    )


@pytest.mark.parametrize(
    "given",
    [
        *(((0, 0, 0), np.eye(3)), [[1, 2], [3], [4]], [np.eye(4), np.eye(3)], (1, (2, 3)), [[1, 2], {3}]),
        *([np.eye(3), np.zeros(3)], [np.array(1.0), [2]]),
    ],
)
def test_parts_of_several_shapes_are_no_pose(given):
    assert error_of(check_pose, given) == (
        f"pose must have shape (4, 4) (got a {type(given).__name__} of parts of several shapes; sonar_gl.pose makes "
        "one from x y z roll pitch yaw)"
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_lies_within_a_million_kilometres(axis):
    place = [0.0, 0.0, 0.0]
    for sign in (1, -1):
        place[axis] = sign * 1e9
        check_pose(pose(*place))
        place[axis] *= 1 + 1e-9
        with pytest.raises(Error, match="pose must lie within 1e\\+09 m of the origin"):
            check_pose(pose(*place))


@pytest.mark.parametrize("pitch", [0.4, np.pi / 2, -np.pi / 2])
def test_the_numbers_of_a_pose_give_it_back(pitch):
    """Straight up and down, too, where roll and yaw have the same axis."""
    one = pose(1, 2, 3, 0.7, pitch, -2.1)
    np.testing.assert_allclose(pose(*pose_numbers(one)), one, rtol=0, atol=1e-15)


def test_angles_beyond_a_turn_are_no_radians():
    np.testing.assert_allclose(pose(yaw=2 * np.pi), np.eye(4), rtol=0, atol=3e-16)
    for angles in ((6.3, 0, 0), (0, -6.3, 0), (0, 0, 90)):
        with pytest.raises(Error, match="pose angles must be radians, within ±2π"):
            pose(0, 0, 0, *angles)


def test_unwrapped_angles_are_warned_of_once(tmp_path):
    yaws = [0, 3, 6, 9, 6, 3, 0, 0, 0, 0, 3, 6, 9, 6, 3]
    path = tmp_path / "p.csv"
    path.write_text("\n".join([HEADER, *(f"{k},0,0,0,0,0,{yaw}" for k, yaw in enumerate(yaws))]))
    with pytest.warns(UserWarning, match="line 5: angles go beyond") as caught:
        read_poses(path)
    assert len(caught) == 1


def test_times_of_any_sign_have_a_bound(message, read):
    assert read("-1e10,0,0,0,0,0,0", "1e10,0,0,0,0,0,0")[0].tolist() == [-1e10, 1e10]
    assert message("-1.1e10,0,0,0,0,0,0") == (
        "line 2, column t: must lie in -1e+10..1e+10 (got -1.1e+10; give seconds)"
    )


@pytest.mark.parametrize("length", [0.0, 0.98, 1.011])
def test_quaternions_of_another_length_are_refused(message, length):
    text = message(f"0,1,2,3,0,0,0,{length}", header="t,x,y,z,qx,qy,qz,qw")
    assert text == (
        f"line 2: qx qy qz qw must be a unit quaternion (got 0 0 0 {length:g}, of length {length:.3g})"
    )


def test_a_pose_in_float32_that_rounding_has_moved_is_warned_of_once():
    """500 km from the origin, as in UTM, it lay up to 16 mm beside its place."""
    far, near = pose(500_000.013, 4.0, -2.0), pose(60_000.0, 4.0, -2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for one in far, near, near.astype(np.float32), far.tolist():
            check_pose(one)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("default")
        for number in range(3):
            Body(f"b{number}", trimesh.creation.box((1, 1, 1)), far.astype(np.float32))
    (one,) = found
    assert str(one.message).startswith(
        "poses in float32 round places 65536 m or more from the origin, by up to 4 mm "
    )
    assert one.filename == __file__

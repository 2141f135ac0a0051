"""Rigid poses: construction from six numbers, checks, and CSV files."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Iterable, Sequence
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import TextIO

import numpy as np

from sonar_gl.core.checks import count_axes, frozen_array, is_position_and_quaternion, shown
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_kind_of_file, is_utf_16, read_error_text
from sonar_gl.core.warn import warn_caller

TURN_RAD = 2 * np.pi + 1e-6  # with room for rounded numbers
POSE_HINT = "sonar_gl.pose makes one from x y z roll pitch yaw"
QUATERNION_HINT = (
    "of a position and a quaternion, fill np.eye(4): [:3, :3] with scipy.spatial.transform.Rotation.from_quat(xyzw)"
    ".as_matrix(), and [:3, 3] with the position"
)
MAX_UNWRAPPED_RAD = 1e5  # 16000 turns, of which float64 still resolves 1e-11 rad
ROUNDED = 1e-3  # deviation from a rotation that rounding may have caused, and hardly a scale
MAX_POSITION_M = 1e9  # of an origin; squares of much greater lengths overflow
MAX_TIME_S = 1e10  # Unix time with room to spare
MAX_SCALE = 1e3  # and its inverse: of what is smaller or larger, lengths are in other units
UNSCALED = 1e-5  # deviation from a rotation that is rounding, as of the square of a scale from 1
SINGLE_PRECISION_M = 2.0**16  # from here on float32 holds places to 8 mm, about a bin, or less finely


def check_pose(matrix, what: str = "pose", may_scale: bool = False) -> np.ndarray:
    """Return a rigid (4, 4) float64 `world_from_x`; raise an `Error` if the matrix is not rigid.

    Warns of one in float32 so far from the origin, as in UTM, that its place has been rounded.

    may_scale : allow one scale for all axes, as of a body that is larger or smaller than its mesh
    """
    hint = QUATERNION_HINT if is_position_and_quaternion(matrix) else POSE_HINT
    out = frozen_array(matrix, np.float64, (4, 4), what, hint)
    # Python floats take a sixth of NumPy's time for nine numbers, and this runs at every ping.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = out.tolist()
    if may_scale and abs((square := a * a + b * b + c * c) - 1) > UNSCALED:
        scale = math.sqrt(square)
        if not 1 / MAX_SCALE <= scale <= MAX_SCALE:
            raise Error(f"{what} must scale by {1 / MAX_SCALE:g}..{MAX_SCALE:g} (got {scale:g}; give metres)")
        a, b, c, d, e, f, g, h, i = (number / scale for number in (a, b, c, d, e, f, g, h, i))
    lengths = a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1
    angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    turn = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if (deviation := max(map(abs, lengths + angles))) > UNSCALED or turn < 0:
        advice = "scale the mesh instead"
        if deviation < ROUNDED and turn > 0:
            advice = "if it is a product of many poses, or float32, rounding adds up: make it anew by sonar_gl.pose"
        if may_scale:
            must, does = (
                "a rotation, a translation and one scale for all axes",
                "shears, reflects or stretches",
            )
        else:
            must, does = "a rotation and a translation", "scales, shears or reflects"
        raise Error(f"{what} must be {must} (its 3x3 part {does}; {advice})")
    if last != [0.0, 0.0, 0.0, 1.0]:
        raise Error(f"{what} must have the last row 0 0 0 1 (got {last})")
    if max(abs(x), abs(y), abs(z)) > MAX_POSITION_M:
        raise Error(
            f"{what} must lie within {MAX_POSITION_M:g} m of the origin (got x y z = {x:g} {y:g} {z:g}; give metres)"
        )
    if getattr(matrix, "dtype", None) == np.float32 and max(abs(x), abs(y), abs(z)) >= SINGLE_PRECISION_M:
        # the same words for all poses: Python shows them once
        warn_caller(
            f"poses in float32 round places {SINGLE_PRECISION_M:.0f} m or more from the origin, by up to 4 mm "
            "there and half a metre at northings of UTM (make them in float64 from the start, or take a nearer origin)"
        )
    return out


def scales_of(poses: np.ndarray) -> np.ndarray:
    """Return the scales (n,) of (n, 4, 4) poses, exactly 1 of rigid ones.

    >>> scales_of(np.array([np.eye(4), np.diag([2.0, 2.0, 2.0, 1.0])])).tolist()
    [1.0, 2.0]
    """
    squares = (poses[:, :3, 0] ** 2).sum(axis=1)
    return np.sqrt(np.where(np.abs(squares - 1) <= UNSCALED, 1.0, squares))


def scale_of(pose: np.ndarray) -> float:
    """Return the scale of a (4, 4) pose, or of its first three rows, exactly 1 of a rigid one.

    >>> scale_of(np.diag([2.0, 2.0, 2.0, 1.0]))
    2.0
    """
    x, y, z = pose[:3, 0].tolist()  # as floats: planes of many bodies ask for it at every ping
    square = x * x + y * y + z * z
    return 1.0 if abs(square - 1) <= UNSCALED else math.sqrt(square)


def unscaled(matrix: np.ndarray) -> np.ndarray:
    """Return a (4, 4) pose without its scale."""
    out = matrix.copy()
    out[:3, :3] /= scale_of(matrix)
    return out


def pose_numbers(matrix: np.ndarray) -> tuple[float, ...]:
    """Return x y z roll pitch yaw of a (4, 4) pose, metres and radians: the arguments of `pose`.

    >>> [round(x, 9) for x in pose_numbers(pose(1, 2, 3, 0.1, -0.2, 0.3))]
    [1.0, 2.0, 3.0, 0.1, -0.2, 0.3]
    """
    (a, b, _), (d, e, _), (g, h, i) = matrix[:3, :3].tolist()
    pitch = np.arctan2(-g, np.hypot(a, d))
    if np.hypot(a, d) < 1e-9:  # straight up or down: roll and yaw have the same axis
        roll, yaw = 0.0, np.arctan2(-b, e)
    else:
        roll, yaw = np.arctan2(h, i), np.arctan2(d, a)
    return (*matrix[:3, 3].tolist(), float(roll), float(pitch), float(yaw))


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> np.ndarray:
    """Return `world_from_sonar` for SDF's six numbers: metres, and fixed-axis x-y-z angles in radians.

    Convention: R = Rz(yaw) Ry(pitch) Rx(roll), x forward, y left (port), z up.

    Returns
    -------
    (4, 4) float64

    Raises
    ------
    Error
        if a number is not finite, or an angle is beyond ±2π, as degrees would be. A heading that a vehicle sums over
        many turns is wrapped first: `math.remainder(yaw, 2 * math.pi)`.

    >>> (pose(1, 2, 3, yaw=np.pi / 2) @ [1, 0, 0, 1]).round(6).tolist()
    [1.0, 3.0, 3.0, 1.0]
    """
    given = [x, y, z, roll, pitch, yaw]
    # to ask NumPy about six numbers takes a third of the time of a pose
    if not all(isinstance(number, float | int) or count_axes(number) == 0 for number in given):
        name, several = next((n, v) for n, v in zip(COLUMNS[1:], given, strict=True) if count_axes(v) != 0)
        raise Error(
            f"pose takes six numbers, x y z roll pitch yaw (got {name} = {shown(several)}; of an array of six numbers "
            "write sonar_gl.pose(*numbers))"
        )
    numbers = frozen_array(given, np.float64, (6,), "pose x y z roll pitch yaw")
    if np.abs(numbers[3:]).max() > TURN_RAD:
        raise Error(
            f"pose angles must be radians, within ±2π (got roll pitch yaw = {roll:g} {pitch:g} {yaw:g}; "
            "if these are degrees, multiply by π/180; if one is the sum of many turns, wrap it: "
            "math.remainder(yaw, 2 * math.pi))"
        )
    out = np.empty((4, 4))
    _fill_poses(out, numbers)
    return out


def _fill_poses(out: np.ndarray, numbers: np.ndarray) -> None:
    """Write the (..., 4, 4) poses of (..., 6) numbers: x y z roll pitch yaw."""
    roll_pitch_yaw = numbers[..., 3:]
    (sr, sp, sy), (cr, cp, cy) = np.sin(roll_pitch_yaw).T, np.cos(roll_pitch_yaw).T
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, numbers[..., 0]),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, numbers[..., 1]),
        (-sp, cp * sr, cp * cr, numbers[..., 2]),
        (0.0, 0.0, 0.0, 1.0),
    )
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            out[..., i, j] = value


COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
QUATERNION = "qx", "qy", "qz", "qw"  # columns that may stand in place of the three angles
OFF_LENGTH = 1e-2  # of a unit quaternion, by the rounding of a file


def read_poses(path) -> tuple[np.ndarray, np.ndarray]:
    """Read times and poses from a CSV file whose first line names its columns: t,x,y,z,roll,pitch,yaw.

    Raises Error if a column is missing, a line has too few or too many cells, a cell is not a finite number, a time is
    earlier than the one before, a time or a place is too great for a ping, an angle looks like degrees, a quaternion is
    no unit one, or the file has no pose. The message names file, line and column.

    Returns the times, (N,) float64, and the poses, (N, 4, 4) float64 world_from_sonar.

    path : file with seconds, metres and radians. The order of columns is free; other columns and empty lines are
        ignored. Times do not fall from row to row. Angles lie within ±2π; beyond, each goes on from the row before by
        less than π, as unwrapped angles do, and there is a warning, since degrees may do so, too. In place of the
        angles may stand qx,qy,qz,qw, a unit quaternion, q or -q
    """
    path = Path(path)
    check_kind_of_file(path, pipe=True)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            numbers, lines, mistake = _read_rows(path, file)
    except OSError as why:
        raise Error(f"{path}: the file of poses must be readable ({read_error_text(why)})") from None
    except UnicodeDecodeError as why:
        got = "UTF-16" if is_utf_16(why.object) else f"byte 0x{why.object[why.start]:02x}"
        raise Error(
            f"{path}: the file of poses must be text in UTF-8 (got {got}; save it as UTF-8)"
        ) from None
    except ValueError as why:  # a null character in its name
        raise Error(f"{path}: the file of poses must be readable ({why})") from None
    if len(numbers):
        _check_rows(path, numbers, lines)
    if mistake is not None:  # in a line after those
        raise mistake
    if not len(numbers):
        raise Error(f"{path}: must hold at least one pose, under the header {','.join(COLUMNS)} (got none)")
    poses = np.empty((len(numbers), 4, 4))
    fill = _fill_poses if numbers.shape[1] == len(COLUMNS) else _fill_from_quaternions
    fill(poses, numbers[:, 1:])
    return numbers[:, 0].copy(), poses


def rotation_rows(x, y, z, w) -> tuple[tuple, ...]:
    """Return the three rows of the rotation of a unit quaternion; of arrays, those of several."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def _fill_from_quaternions(out: np.ndarray, numbers: np.ndarray) -> None:
    """Write the (N, 4, 4) poses of (N, 7) numbers: x y z qx qy qz qw."""
    quaternions = numbers[:, 3:]
    unit = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    out[:] = np.eye(4)
    out[:, :3, 3] = numbers[:, :3]
    out[:, :3, :3] = np.transpose(rotation_rows(*unit), (2, 0, 1))


def _read_rows(path: Path, file: TextIO) -> tuple[np.ndarray, array, Error | None]:
    """Return the rows of a file of poses up to the first line that is none, and the error about that, if there is one.

    The rows are (N, 7) float64 in the order of COLUMNS, or (N, 8) with a QUATERNION in place of the angles. Between
    them and the error stand the numbers of their lines.
    """
    numbers, lines, columns, mistake = array("d"), array("q"), dict.fromkeys(COLUMNS), None
    rows = csv.reader(file, skipinitialspace=True)
    filled = (cells for cells in rows if any(map(str.strip, cells)))
    try:
        header = next(filled, COLUMNS)
        columns = _column_indices([cell.strip() for cell in header])
        pick = itemgetter(*columns.values())
        for cells in filled:
            if len(cells) != len(header):
                raise Error(f": must have {len(header)} cells, as the header has (got {len(cells)})")
            numbers.extend(_finite_numbers(pick(cells), columns))
            lines.append(rows.line_num)
    except csv.Error as why:
        mistake = Error(f"{path}: line {rows.line_num}: must be CSV ({why})")
    except Error as why:
        mistake = Error(f"{path}: line {rows.line_num}{why}")
    return np.array(numbers).reshape(-1, len(columns)), lines, mistake


def _check_rows(path: Path, numbers: np.ndarray, lines: Sequence[int]) -> None:
    """Raise an `Error` for the first row that no ping can have, or whose time falls; warn of unwrapped angles."""
    before = np.concatenate([numbers[:1], numbers[:-1]])
    angles, is_quaternion = numbers[:, 4:], numbers.shape[1] > len(COLUMNS)
    is_beyond = (np.abs(angles) > TURN_RAD).any(axis=1) & (not is_quaternion)
    is_jump = (np.abs(angles - before[:, 4:]) >= np.pi).any(axis=1)
    is_jump[0] = True
    is_wrong = is_beyond & (is_jump | (np.abs(angles) > MAX_UNWRAPPED_RAD).any(axis=1))
    if is_quaternion:
        lengths = np.linalg.norm(angles, axis=1)
        is_wrong = np.abs(lengths - 1) > OFF_LENGTH
    falls = numbers[:, 0] < before[:, 0]
    is_late = np.abs(numbers[:, 0]) > MAX_TIME_S
    is_far = (np.abs(numbers[:, 1:4]) > MAX_POSITION_M).any(axis=1)
    if (wrong := np.flatnonzero(is_wrong | falls | is_late | is_far)).size:
        at = wrong[0]
        location = f"{path}: line {lines[at]}"
        if is_late[at]:
            raise Error(
                f"{location}, column t: must lie in {-MAX_TIME_S:g}..{MAX_TIME_S:g} (got {numbers[at, 0]:g}; give "
                "seconds)"
            )
        if is_far[at]:
            raise Error(
                f"{location}: x y z must lie within {MAX_POSITION_M:g} m of the origin (got "
                f"{' '.join(f'{n:g}' for n in numbers[at, 1:4])}; give metres)"
            )
        if falls[at]:
            got = f"{numbers[at, 0]:g} s after {before[at, 0]:g} s"
            raise Error(f"{location}, column t: times must not fall (got {got}; sort the rows)")
        if is_quaternion:
            raise Error(
                f"{location}: qx qy qz qw must be a unit quaternion (got {' '.join(f'{n:g}' for n in angles[at])}, of "
                f"length {lengths[at]:.3g})"
            )
        roll, pitch, yaw = angles[at]
        raise Error(
            f"{location}: pose angles must be radians, within ±2π or unwrapped, in steps of less than π from line "
            f"to line (got roll pitch yaw = {roll:g} {pitch:g} {yaw:g}; if these are degrees, multiply by π/180)"
        )
    if is_beyond.any():
        warn_caller(
            f"{path}: line {lines[is_beyond.argmax()]}: angles go beyond ±2π in small steps, and are taken as "
            "unwrapped radians (if they are degrees, multiply by π/180)"
        )


def _column_indices(header: list[str]) -> dict[str, int]:
    """Return a dict from the name of each column to its index in a line: COLUMNS, or those with a QUATERNION."""
    has_quaternion = set(QUATERNION) & set(header) and not set(COLUMNS) <= set(header)
    names = (*COLUMNS[:4], *QUATERNION) if has_quaternion else COLUMNS
    # as of a spreadsheet where the comma is that of decimals
    cure = "; separate columns by commas" if len(header) == 1 and re.search(r"[;\s]", header[0]) else ""
    others = "" if has_quaternion else f", or {','.join(QUATERNION)} in place of the angles"
    for name in names:
        if header.count(name) != 1:
            what = "more than once" if name in header else "not there"
            raise Error(
                f": column {name} is {what}; the first line must name the columns {','.join(names)}{others} "
                f"(got {shown(','.join(header))}{cure})"
            )
    return {name: header.index(name) for name in names}


def _finite_numbers(cells: Sequence[str], names: Iterable[str]) -> list[float]:
    """Return the numbers of the cells of some columns; raise an `Error` for the first that is none, or not finite."""
    with suppress(ValueError):
        numbers = [*map(float, cells)]
        if all(map(math.isfinite, numbers)):
            return numbers
    name, cell = next(pair for pair in zip(names, cells, strict=True) if not _is_finite(pair[1]))
    raise Error(f", column {name}: must be a finite number (got {shown(cell.strip())})")


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False

"""Motion of the sonar while a ping travels: where it shows its echoes then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sonar_gl.core.checks import frozen_array
from sonar_gl.core.compiled import compiled
from sonar_gl.core.errors import Error
from sonar_gl.ping import BIN_LABELS, Ping, changed_powers
from sonar_gl.sonar.sonar import Sonar

MAX_M_S, MAX_RAD_S = 30.0, 20.0
WHOLE_TURN = 2 * math.pi  # after which bearings repeat, whatever the fan


def check_velocity(velocity) -> np.ndarray | None:
    """Return (6,) float64, or None for None.

    Raises Error if it is not six finite numbers within bounds.
    """
    if velocity is None:
        return None
    out = frozen_array(velocity, np.float64, (6,), "velocity vx vy vz wx wy wz")
    if np.abs(out[:3]).max() > MAX_M_S or np.abs(out[3:]).max() > MAX_RAD_S:
        raise Error(
            f"velocity must be metres per second within ±{MAX_M_S:g} and radians per second within "
            f"±{MAX_RAD_S:g}, vx vy vz wx wy wz (got {out.tolist()})"
        )
    return out


def _range_factor(azimuth_rad, velocity, sound_speed_m_s):
    """Return the range that is shown over that at rest, see `shown_in_motion`.

    >>> float(round(30.0 * _range_factor(0.0, [2.0, 0, 0, 0, 0, 0.5], 1500.0), 4))
    29.9601
    """
    ahead = velocity[0] * np.cos(azimuth_rad) + velocity[1] * np.sin(azimuth_rad)
    return 1 / (1 + ahead / sound_speed_m_s)


def _bearing_change_rad(azimuth_rad, shown_m, velocity, sound_speed_m_s, set_speed_m_s):
    """Return the bearing at a range that is shown, less that at rest, see `shown_in_motion`.

    >>> float(round(_bearing_change_rad(0.0, 29.9601, [2.0, 0, 0, 0, 0, 0.5], 1500.0, 1500.0), 4))
    -0.02
    """
    aside = velocity[1] * np.cos(azimuth_rad) - velocity[0] * np.sin(azimuth_rad)
    return -velocity[5] * 2 * shown_m / set_speed_m_s - 2 * aside / sound_speed_m_s


@compiled
def _redistribute(powers, cells, scale, shift, edges, turn, out):
    """Distribute what rows of cells hold among other cells, by overlap.

    powers : (rows, n); cells : (n + 1,) edges of them, rising, which lie in a row at scale × cells + shift;
        scale, shift : (rows,); edges : (m + 1,) of the others; turn : period after which they repeat, 0
        for none; out : (rows, m), added to
    """
    n_cells = edges.shape[0] - 1
    for row in range(powers.shape[0]):
        first_way, last_way = 0, 0
        if turn > 0.0:  # as often as a row lies among the edges: a fast turn may be more than a whole one
            first, last = scale[row] * cells[0] + shift[row], scale[row] * cells[-1] + shift[row]
            first_way, last_way = math.ceil((edges[0] - last) / turn), math.floor((edges[-1] - first) / turn)
        for way in range(first_way, last_way + 1):
            begin = 0
            for i in range(powers.shape[1]):
                low = scale[row] * cells[i] + shift[row] + way * turn
                high = scale[row] * cells[i + 1] + shift[row] + way * turn
                while begin < n_cells and edges[begin + 1] <= low:
                    begin += 1
                if powers[row, i] == 0.0:
                    continue
                k, density = begin, powers[row, i] / (high - low)
                while k < n_cells and edges[k] < high:
                    out[row, k] += density * (min(high, edges[k + 1]) - max(low, edges[k]))
                    k += 1


def _cell_edges(azimuth_rad, width_rad: float) -> np.ndarray:
    """Return (B + 1,) azimuths half way between beams; of one beam its width."""
    if len(azimuth_rad) == 1:
        return azimuth_rad[0] + width_rad * np.array([-0.5, 0.5])
    between = (azimuth_rad[1:] + azimuth_rad[:-1]) / 2
    return np.concatenate([[2 * azimuth_rad[0] - between[0]], between, [2 * azimuth_rad[-1] - between[-1]]])


def _in_head(velocity, sonar: Sonar):
    """Return a velocity in the frame of the housing as one in that of the head."""
    if sonar.tilt_deg == 0:
        return velocity
    return (np.reshape(velocity, (2, 3)) @ sonar.sonar_from_head[:3, :3]).ravel()


def shown_in_motion(ping: Ping, velocity) -> Ping:
    """Return the ping of a sonar at rest as a moving one shows it.

    An echo from r returns after t, about 2r/c. Until then the sonar has turned by w_z t, so that the bearing
    is ψ − w_z t; and it has come v·d t nearer along d, the direction of the echo: c t is 2r − v·d t, and
    r / (1 + v·d/c) is shown. Its motion at right angles to d, over r, turns the bearing, too.

    The echo in a cell of beam and bin is shared among the cells that cover its new place, half way to the beams
    beside it, so that the sum over beams, each times the angle it covers, stays except for what leaves the fan
    and the range. What leaves a wide fan, or turns far, may enter it on the other side; what was not in it at first
    stays dark: the sound went out before. Labels are those of the nearest cell; `body_echo` stays.

    ping : with its sonar and acoustics
    velocity : (6,) vx vy vz, m/s, and wx wy wz, rad/s, in the frame of the housing; or None for a sonar at rest.
        In the frame of the head, pitch, roll and heave change which elevations are received, and are left out.
        Elevations are left out, too: what a conical beam at 60 degrees receives from 10 degrees above the fan's
        plane turns by 6 % less than what lies in it
    """
    if velocity is None:
        return ping
    sound_speed = ping.acoustics.water.sound_speed()
    speeds = sound_speed, ping.acoustics.assumed_sound_speed_m_s()
    sonar, r, own = ping.sonar, ping.range_m, ping.azimuth_rad
    given, velocity = velocity, _in_head(velocity, sonar)
    azimuth = _cell_edges(own, math.radians(sonar.beam_width_deg))
    edges = sonar.range_min_m + ping.bin_size_m * np.arange(len(r) + 1)
    # first along each beam, then, as it depends on the range that is shown, across the beams
    width = np.diff(azimuth)[:, None].astype(np.float32)
    factor, even = _range_factor(own, velocity, sound_speed), np.ones(len(r))
    aside = azimuth + _bearing_change_rad(azimuth, 0.0, velocity, *speeds)
    turned = _bearing_change_rad(0.0, r, velocity, *speeds) - _bearing_change_rad(0.0, 0.0, velocity, *speeds)

    def shown(power: np.ndarray) -> np.ndarray:
        along, across = (np.zeros(shape, np.float32) for shape in (power.shape, power.shape[::-1]))
        _redistribute(power, edges, factor, np.zeros(len(own)), edges, 0.0, along)
        _redistribute(
            np.ascontiguousarray((along * width).T), aside, even, turned, azimuth, WHOLE_TURN, across
        )
        return np.ascontiguousarray(across.T / width)

    labels = {name: getattr(ping, name) for name in BIN_LABELS if getattr(ping, name) is not None}
    if labels:
        # where the middle of each cell was at rest, to the first order
        was = own[:, None] - _bearing_change_rad(own[:, None], r, velocity, *speeds)
        was = (was - azimuth[0]) % WHOLE_TURN + azimuth[0]
        beam = np.searchsorted(azimuth, was, side="right") - 1
        bin_ = np.searchsorted(edges, r / _range_factor(was, velocity, sound_speed), side="right") - 1
        inside = (beam >= 0) & (beam < len(own)) & (bin_ >= 0) & (bin_ < len(r))
        cell = beam.clip(0, len(own) - 1), bin_.clip(0, len(r) - 1)
        for name, array in labels.items():  # those of the nearest cell
            labels[name] = np.where(inside, array[cell], array.dtype.type(BIN_LABELS[name]))
            labels[name].setflags(write=False)
    meta = {**ping.meta, "velocity": [float(v) for v in given]}
    return replace(ping, meta=meta, **changed_powers(ping, shown), **labels)

"""Judge the tests by mutations: small mistakes in the code that some test must notice.

    python -m tools.mutations --list                      # the table, and where each applies
    python -m tools.mutations --run --only "labels/*"     # these; prints killed or survived, and the score

A mutation is looked up by its tokens, so that line breaks and spaces do not matter; it must occur once in the
package. The tree is copied to a temporary folder, one mutation is applied, and pytest runs with -x. First the
same tests run without a mutation: a mutation says nothing where they fail by themselves. A mutation is killed
if a test fails, if pytest ends otherwise, or if it takes longer than a quarter of an hour.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parents[1]
UNCOPIED = (".git", ".venv", ".hypothesis", ".pytest_cache", ".ruff_cache", "out", "build", "pictures")
TOKEN = re.compile(r"\w+|[^\w\s]")
PASSED = 0  # exit status of pytest
TIMEOUT_S = 900.0


@dataclass(frozen=True)
class Mutation:
    """One mistake.

    Attributes
    ----------
    name : ROOM/what is wrong
    old, new : text of the package, and what takes its place
    tests : modules that are run, without .py, or test_module::test_name; with the folder where two have one name
    """

    name: str
    old: str
    new: str
    tests: tuple[str, ...]


FOOTPRINTS = ("test_footprint", "test_failures")
SMOOTH_FLOOR = "test_closed_forms::test_a_few_rows_of_a_smooth_floor_follow_the_pattern"
PLANES = "test_closed_forms::test_planes"
STRIPS = ("test_strips",)
CONES = ("test_cones",)
BUBBLES = ("test_bubbles", "test_footprint")
MISSED = "test_adaptive::TestBodiesThatSamplesMiss"
GRAZING = f"{MISSED}::test_a_ball_on_a_floor_is_not_hidden_by_what_is_nearer_of_the_floor"
JUDGED = ("test_adaptive::test_the_error_of_a_body_is_judged_by_what_its_samples_show",)
LABELS = ("test_labels",)
MULTIPATH = ("test_multipath",)
TRIANGLES = ("test_engines", "test_specular")
CULLING = ("test_cull", "test_level_of_detail", "test_window")
ADAPTIVE = ("test_adaptive", "test_moving_bodies", "test_sequence")
LEVEL_SEARCH = ("test_level_search",)
NOISE = (
    "test_noise",
    "test_speckle",
    "test_receiver",
    "test_k_distribution",
    "test_place_locked_speckle",
)
SCATTERERS, COMMON = ("test_scatterers",), ("test_common_noise",)
CROSS_TALK, VOLUME, RING_DOWN = ("test_cross_talk",), ("test_volume",), ("test_ring_down",)
SURFACE = ("test_surface_reverberation",)
STORE = ("test_store",)
ENCODING = ("batch/test_batch",)
RECORDS = ("test_records",)
POWER = ("test_power_failure",)
GUARD = ("test_state_guard", "test_modes")
COUNTS = ("test_counts",)
POSES, FAN = ("test_poses",), ("test_fan_image",)
SDF, SENSORS = ("test_sdf",), ("test_sensors",)
SAMPLING, REQUESTS, EMPTY_PINGS = ("test_sampling",), ("batch/test_batch",), ("test_simulator",)
RESTS = ("batch/test_batch::test_bodies_rest_on_a_floor_however_they_turn",)
CLEAR = ("batch/test_batch::test_bodies_keep_clear_of_each_other",)
ABSENT = ("batch/test_batch::test_a_body_without_a_clear_place_is_absent",)
BESIDE_FLOOR = ("batch/test_batch::test_what_rests_takes_plumes_along_and_keeps_its_height_beside_the_floor",)
FIRST_PLACE = ("batch/test_batch::test_a_sonar_is_inside_a_body_where_the_first_ping_has_both",)
EXTENT, SIGNALS, IMAGE_SAMPLING = ("test_extent",), ("test_sigterm",), ("test_image_sampling",)
ROOM = ("test_workspace",)
AGAIN = ("test_labels::test_samples_are_summed_again_where_there_was_too_little_room",)
ESTIMATE = ("test_multipath::test_the_estimate_of_reflections_is_an_integral_over_the_fan",)
EXPECTED = ("test_multipath::test_what_an_image_sees_of_a_body_is_expected_sample_by_sample",)
BY_IMAGES = (
    "test_multipath::test_a_body_that_echoes_by_way_of_the_surface_alone_has_the_samples_that_it_needs",
    "test_multipath::test_rods_by_way_of_the_surface_have_more_samples_than_the_wall_before_the_sonar",
)
BY_THE_FLOOR = ("test_multipath::test_bodies_above_the_water_do_not_echo_by_way_of_the_floor",)
SONAR_FILES, STYLES = ("sonar/test_sonar", "test_sonar_files"), ("test_styles",)
LEVELS = ("test_level_of_detail::test_the_patch_of_the_whole_mesh_is_halved_until_it_has_few_faces",)
PATCHES = (
    "test_level_of_detail::test_the_rasteriser_has_room_for_the_vertices_of_any_patch",
    "test_level_of_detail::test_a_small_mesh_is_one_patch_and_a_larger_one_has_no_coarser_levels",
)
GIVEN_UP = ("test_cluster::test_parts_that_workers_died_of_are_left_to_the_caller",)
DIGEST = ("batch/test_batch::test_the_surface_and_places_of_plumes_are_known_to_the_digest",)
REFLECTIVITY, BOXES, WARN = ("test_state", "test_changes_per_ping"), ("test_boxes",), ("test_warn",)

SEEN_ROD = "test_adaptive::test_a_thin_body_that_no_sample_met_is_seen_between_its_vertices"
HIDDEN = "test_adaptive::test_a_body_that_few_samples_met_is_not_hidden_by_them"
BETWEEN_BOXES = "test_adaptive::test_a_body_between_boxes_changes_neither_samples_nor_echo"
RECEIVED_SAMPLES = "test_adaptive::test_samples_between_boxes_are_those_that_no_beam_receives"
ENDS_EARLY = "test_sequence::test_an_iterator_that_ends_before_the_poses_is_an_error_after_the_pings_before"
CHANGED_MESH = "test_moving_bodies::test_a_mesh_that_was_changed_in_place_is_added_with_its_new_shape"
WEIGHED = "test_adaptive::test_what_a_view_shows_of_bodies_is_weighed_by_their_kind"
COUNTED = "test_adaptive::test_a_body_counts_if_its_echo_is_strong_or_is_not_known"
BESIDE_FAN = "test_adaptive::test_a_body_beside_the_fan_counts_as_far_as_its_beams_receive"
MOVED_LEVEL = "test_adaptive::TestMoving::test_a_check_moves_the_level_as_far_as_there_are_samples"
AFTER_ONE_ALONE = "test_adaptive::TestMoving::test_the_next_pings_follow_one_whose_samples_were_chosen_alone"
CORNER = "test_adaptive::test_a_body_in_the_place_of_another_needs_no_finer_samples"

MUTATIONS = (
    # numbers of poses, and pictures of fans
    Mutation("poses/reflections", "1e-5 or turn < 0", "1e-5", POSES),
    Mutation("poses/last row", "if last != [0.0, 0.0, 0.0, 1.0]:", "if last[:3] != [0.0, 0.0, 0.0]:", POSES),
    Mutation(
        "poses/straight up", "roll, yaw = 0.0, np.arctan2(-b, e)", "roll, yaw = 0.0, np.arctan2(b, e)", POSES
    ),
    Mutation(
        "poses/times before 1970", "is_late = np.abs(numbers[:, 0])", "is_late = (numbers[:, 0])", POSES
    ),
    Mutation("poses/warned of again", "is_unwrapped |= _check_rows", "is_unwrapped = _check_rows", POSES),
    Mutation(
        "fan image/fan to starboard",
        "half = min(max(-edges[0], edges[1])",
        "half = min(max(edges[1], edges[1])",
        FAN,
    ),
    Mutation("fan image/astern", "middle + np.remainder(azimuth - middle", "0 + np.remainder(azimuth", FAN),
    Mutation("empty pings/above the fan", "[[slope, 0, 1], [slope, 0, -1]]", "[[slope, 0, 1]]", EMPTY_PINGS),
    Mutation(
        "empty pings/corners of the fan",
        "math.radians(top_deg)) / math.cos(half)",
        "math.radians(top_deg))",
        EMPTY_PINGS,
    ),
    Mutation("fan image/more than a circle", "float(edges[1] - excess)", "float(edges[1])", FAN),
    Mutation("axes/first spoke", "math.ceil(first - 1e-6)", "math.ceil(first + 1e-6)", ("test_axes",)),
    Mutation("axes/side of labels", 'f"{deg:+g}" if deg else', 'f"{-deg:+g}" if deg else', ("test_axes",)),
    Mutation(
        "axes/counts of the bar",
        "np.linspace(bottom, top, len",
        "np.linspace(top, bottom, len",
        ("test_axes",),
    ),
    Mutation(
        "counts/bounds of the gain",
        "gain_db = min(max(gain_db, -LEVEL_BOUND_DB)",
        "gain_db = min(max(gain_db, -1e9)",
        COUNTS,
    ),
    Mutation(
        "noise/pattern of interference",
        "aperture_width(taper) * offset",
        "aperture_width(taper) / 2 * offset",
        NOISE,
    ),
    Mutation(
        "pulse/length of field weights",
        "int(MAX_FIELD_NULLS / min(ratio, 1))",
        "half_length",
        ("test_pulse",),
    ),
    # footprints of samples into columns and bins
    Mutation("footprints/slant without a width", "/ max(wide, LEAST_WIDTH * s)", "/ wide", FOOTPRINTS),
    Mutation("footprints/ramp", "t * t * (t / 3 + start / 2)", "t * t * (t / 3 + start / 3)", FOOTPRINTS),
    Mutation("footprints/box height", "(s[m] if past else 0.25)", "(s[m] if past else 0.3)", FOOTPRINTS),
    Mutation(
        "footprints/no trapezoids", "if 2 * thin * per_metre >= short_ramp * s * s:", "if False:", FOOTPRINTS
    ),
    Mutation(
        "footprints/inner bins",
        "bins_s[last], 0.0, np.float32(2 * half_height)",
        "bins_s[last], 0.0, np.float32(half_height)",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/slant of inner bins",
        "steepness, middle_s = np.float32(2 * half_height * rise)",
        "steepness, middle_s = np.float32(-2 * half_height * rise)",
        (*FOOTPRINTS, SMOOTH_FLOOR),
    ),
    Mutation(
        "footprints/slant of the first bin",
        "slanted = max(1.0 + rise * ((near + inner)",
        "slanted = max(1.0 - rise * ((near + inner)",
        (*FOOTPRINTS, SMOOTH_FLOOR),
    ),
    Mutation(
        "footprints/an end beyond the edge of its bin",
        "np.float32(max(half_height * (outer**2 - far * far), 0.0) * slanted)",
        "np.float32(half_height * (outer**2 - far * far) * slanted)",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/negative density of the last bin",
        "slanted = max(1.0 + rise * ((outer + far) / 2 - s), 0.0)",
        "slanted = 1.0 + rise * ((outer + far) / 2 - s)",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/negative density at an end",
        "return max(1.0 + rise * min(max((nearer + further) / 2 - s, -wide), wide), 0.0)",
        "return 1.0 + rise * min(max((nearer + further) / 2 - s, -wide), wide)",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/slant of ramps",
        "rise * min(max((nearer + further) / 2 - s, -wide), wide)",
        "rise * ((nearer + further) / 2 - s)",
        FOOTPRINTS,
    ),
    Mutation("footprints/slant of trapezoids", "slant / wide if slant != 0.0 else 0.0", "0.0", FOOTPRINTS),
    Mutation(
        "footprints/slant of a bin of a trapezoid",
        "nearer, high = further, edge",
        "nearer = further",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/slant of steep patterns",
        "rise = min(max(change[m], -1.0), 1.0)",
        "rise = change[m]",
        (SMOOTH_FLOOR,),
    ),
    Mutation(
        "footprints/slant by the pattern",
        "(rise if is_nearer_above else -rise) if is_slanted else 0.0",
        "rise if is_slanted else 0.0",
        (SMOOTH_FLOOR,),
    ),
    Mutation(
        "footprints/face of number 0",
        "n_faces += (face != before) | (m == uint64(0))",
        "n_faces += face != before",
        ("test_joined_rows",),
    ),
    Mutation(
        "footprints/ends of several rows",
        "even_b = inner if b[m] < -2.0 * bow else",
        "even_b = inner if b[m] < -1.0 * bow else",
        ("test_joined_rows",),
    ),
    Mutation(
        "footprints/echo of two rows",
        "mean_of_ends if further < 1.5 else (",
        "mean_of_ends if further < 0.5 else (",
        ("test_joined_rows",),
    ),
    Mutation("footprints/pieces of walls face on", "SLOPE_CHANGE = 1 / 3", "SLOPE_CHANGE = 1e9", (PLANES,)),
    Mutation(
        "footprints/samples behind a strip",
        "last = max(last + 1, first) geometry",
        "last = whole_groups(0, max(last + 1, first))\n    geometry",
        ("test_joined_rows::test_no_bit_depends_on_what_was_in_memory_beside_a_strip",),
    ),
    Mutation(
        "strips/upper end",
        "work[BORDER, 0], work[BORDER, n] = v_low, v_high",
        "work[BORDER, 0] = v_low",
        STRIPS,
    ),
    Mutation(
        "strips/samples of a strip without rows",
        "if n > 0 and face_id.shape[0] > 0",
        "if face_id.shape[0] > 0",
        STRIPS,
    ),
    Mutation(
        "strips/more rows than there is room for",
        "n_rows > MAX_STRIP_ROWS",
        "n_rows > 9 * MAX_STRIP_ROWS",
        STRIPS,
    ),
    Mutation(
        "samples/sixteen times as many at once",
        "min(judged.steps, MOST_STEPS_ALONE)",
        "judged.steps",
        ("test_alone::test_a_ping_takes_no_more_than_four_times_the_samples_at_once",),
    ),
    Mutation(
        "footprints/density of short pieces",
        "LEAST_SLANTED = 1 / 8",
        "LEAST_SLANTED = 1.0",
        (PLANES, "test_joined_rows"),
    ),
    Mutation(
        "footprints/edge where planes meet",
        "meet = (rest[m] - rest[below]) / turn",
        "meet = (rest[below] - rest[m]) / turn",
        (*FOOTPRINTS, *STRIPS),
    ),
    Mutation(
        "footprints/edges of noise",
        "(abs((meet - (low + high) / 2) * turn) > noise)",
        "(abs((meet - (low + high) / 2) * turn) < noise)",
        STRIPS,
    ),
    Mutation(
        "footprints/plane beyond a silhouette",
        "rest[below] if met_low else rest[m]",
        "rest[m] if met_low else rest[below]",
        STRIPS,
    ),
    Mutation(
        "footprints/slope across",
        "abs(along_u[m] - at * uc * one_over_L2)",
        "abs(along_u[m] + at * uc * one_over_L2)",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/length of the ray",
        "abs(along[m] - at * (vc + uc * tilt[m]) * one_over_L2)",
        "abs(along[m])",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/solid angle",
        "echo[m] * across * height * one_over_L * one_over_L2",
        "echo[m] * across * height * one_over_L2",
        FOOTPRINTS,
    ),
    Mutation(
        "footprints/plane in the strip's middle",
        "q[m] + along_u[m] * (line_u[m] - u0",
        "q[m] - along_u[m] * (line_u[m] - u0",
        FOOTPRINTS,
    ),
    # beams that are cones
    Mutation(
        "cones/width of a strip",
        "cosine * (1.0 + vc * vc) + sine * uc, LEAST_AHEAD) * one_over_L",
        "cosine * (1.0 + vc * vc) - sine * uc, LEAST_AHEAD) * one_over_L",
        CONES,
    ),
    Mutation("cones/slope along a strip", "along_v + along_u[m] * tilt[m]", "along_v", CONES),
    Mutation(
        "cones/line of a strip",
        "line_u[m], tilt[m] = uc - slope * vc, slope",
        "line_u[m], tilt[m] = uc, slope",
        CONES,
    ),
    Mutation(
        "cones/rows that rise too steeply", "rise = min(rise, tan_width", "rise = max(rise, tan_width", CONES
    ),
    Mutation("cones/solid angle of columns", "2 * ends * np.cos(shown) * power)", "2 * ends * power)", CONES),
    Mutation(
        "cones/parts below the horizon", "(enters > 0) & (below_low < below_high)", "(enters < 0)", CONES
    ),
    Mutation(
        "cones/mirrored columns", "(mirrored[column], *rest)", "(mirrored[column], *rest[:-1], False)", CONES
    ),
    Mutation("cones/point scatterers", "np.sin(ahead[:, 0]) * level", "np.sin(ahead[:, 0])", CONES),
    Mutation(
        "footprints/columns into beams",
        "rows[1, k] += (a1 * a + b1 * b) + (w1 * c + d1 * d)",
        "rows[1, k] += (a1 * a + b1 * b) + (w1 * c + d1 * c)",
        (
            *FOOTPRINTS,
            "test_beam_pattern",
        ),
    ),
    Mutation(
        "footprints/pattern in elevation",
        "sines = fan.max_sine * np.linspace(-1, 1, 2 * elevations_of(fan)",
        "sines = np.linspace(-1, 1, 2 * elevations_of(fan)",
        ("test_beam_pattern",),
    ),
    Mutation(
        "footprints/side lobes below",
        "((low, high), (-high, -low))",
        "((low, high),)",
        ("test_fan", "test_closed_forms"),
    ),
    Mutation("footprints/edges between planes", "is_edge = are_met & (low", "is_edge = False & (low", STRIPS),
    Mutation("footprints/narrow faces", " & (narrow[below] + narrow[m] == 0.0)", "", STRIPS),
    Mutation("footprints/faces of half a row", "is_low = 2.0 * height", "is_low = 4.0 * height", STRIPS),
    Mutation("footprints/hidden faces", "is_single & (is_unknown | is_low)", "is_single & is_low", STRIPS),
    Mutation("footprints/faces of several rows", "if is_single & (is_unknown", "if (is_unknown", STRIPS),
    Mutation("footprints/horizons", "is_lost = (met_low != met_high)", "is_lost = met_low & False", STRIPS),
    Mutation("footprints/noise of planes", "SAME = 1e-5", "SAME = 1e-2", STRIPS),
    Mutation("footprints/planes apart", "SAME = 1e-5", "SAME = 1e-8", STRIPS),
    Mutation(
        "fan/rows of a sector of side lobes",
        "= 0.75, 16, 1.0",
        "= 0.75, 4, 1.0",
        ("test_closed_forms::test_the_first_bottom_return_with_few_samples",),
    ),
    Mutation(
        "fan/boxes within the transmit beam",
        "_divided(edges, beams.transmit_width_rad / COLUMNS_PER_TRANSMIT_BEAM)",
        "_divided(edges, beams.transmit_width_rad)",
        ("test_beam_pattern",),
    ),
    Mutation(
        "fan/taper without a series",
        'if taper != "taylor":',
        "if False:",
        ("test_beam_pattern::test_a_taper_without_a_series_is_not_taken_for_taylors",),
    ),
    Mutation(
        "fan/behind a straight array",
        'if sonar.steered == "straight" and not beams.is_box:',
        "if False:",
        CONES,
    ),
    # sums of columns and of points
    Mutation(
        "sums/bubbles across the wrap of azimuth",
        "turns = math.floor(true / (2 * math.pi) + 0.5)",
        "turns = 0.0",
        BUBBLES,
    ),
    Mutation(
        "sums/products of apertures that slide back",
        "max(further, 0), n_waves + min(further, 0)",
        "max(further, 0), n_waves",
        ("test_place_locked_speckle",),
    ),
    Mutation(
        "sums/bubbles beyond the aperture", "abs(points[n, 1]) < top", "abs(points[n, 1]) < 2 * top", BUBBLES
    ),
    Mutation(
        "sums/columns received by side lobes alone",
        "out[columns[self.weights[beams] > 0] % len(out)]",
        "out[columns[self.weights[beams] > 2.0] % len(out)]",
        ("test_beam_pattern",),
    ),
    Mutation("sums/share of two columns", "share = (points[n, 0] - middle) / apart", "share = 0.0", BUBBLES),
    # what bodies reflect at most
    Mutation(
        "reflectivity/of a ping",
        "self.own if state.reflectivity is None else self.per_unit * state.reflectivity",
        "self.own",
        REFLECTIVITY,
    ),
    Mutation(
        "reflectivity/factor of faces",
        "np.where(by_face, own, 1.0)",
        "np.ones(len(by_face))",
        REFLECTIVITY,
    ),
    Mutation(
        "reflectivity/that replaces a body's",
        "np.where(by_face, own, 1.0)",
        "1.0 * own",
        REFLECTIVITY,
    ),
    # labels
    Mutation(
        "labels/mean range of a full bin",
        "2.0 / (s[:-1] + s[1:])",
        "1.0 / s[1:]",
        LABELS,
    ),
    Mutation(
        "labels/before an upright edge",
        "np.floor(ends[:, 0] - BEYOND_BODY)",
        "np.floor(ends[:, 0] - 1e3)",
        LABELS,
    ),
    Mutation("labels/range of a ramp", "return t * t / 2", "return t * t / 3", LABELS),
    Mutation(
        "labels/full bins",
        "echo32 * (incidence + incidence_rise * off)",
        "echo32 * (elevation + incidence_rise * off)",
        LABELS,
    ),
    Mutation(
        "labels/slant of trapezoids",
        "slanted, even_echo = slanted_density(rise, s, high, edge, wide), scale",
        "slanted, even_echo = 1.0, scale",
        LABELS,
    ),
    Mutation(
        "labels/slant of boxes",
        "rise = work[SLANT, m] / max(work[A, m], work[B, m], LEAST_WIDTH * s)",
        "rise = 0.0",
        LABELS,
    ),
    Mutation(
        "labels/rise of elevation",
        "elevation_rise[m] = rise if is_nearer_above else -rise",
        "elevation_rise[m] = (rise if is_nearer_above else -rise) if strip.are_joined else 0.0",
        LABELS,
    ),
    Mutation(
        "labels/highest end of a footprint",
        "share * min(rise, math.pi / 2 - abs(elevation[m]))",
        "share * rise",
        LABELS,
    ),
    Mutation(
        "labels/steepest end of a footprint",
        "min(b[m] / max(past, LEAST_POWER), incidence[m], below)",
        "min(b[m] / max(past, LEAST_POWER), incidence[m])",
        LABELS,
    ),
    Mutation("labels/incidence", "+ along_v * along_v - towards * towards", "- towards * towards", LABELS),
    Mutation(
        "labels/arctan",
        "p * x - 0.0752896400",
        "p * x + 0.0752896400",
        LABELS,
    ),
    Mutation(
        "labels/range of point bins",
        "np.float32(work[ENERGY, m] - echo * middle_m[k])",
        "np.float32(work[ENERGY, m])",
        LABELS,
    ),
    Mutation(
        "labels/strongest body",
        "body_id[bins + k] = body if stronger[k] else body_id[bins + k]",
        "body_id[bins + k] = body",
        LABELS,
    ),
    Mutation(
        "labels/faint bins",
        "_clear(labels, intensity, np.full((1, 1), least, np.float32))",
        "_clear(labels, intensity, np.full((1, 1), 0.0, np.float32))",
        LABELS,
    ),
    Mutation(
        "labels/own echo",
        "share[b, first + k] * echo[b, first + k] < least[0, 0]",
        "echo[b, first + k] < least[0, 0]",
        LABELS,
    ),
    Mutation(
        "labels/echo over a body",
        "max(total[bins + k], direct[b, k0 + k] / gain[k0 + k])",
        "total[bins + k]",
        LABELS,
    ),
    Mutation(
        "labels/multipath over a body",
        "total = direct + other",
        "total = direct + 0 * other",
        LABELS,
    ),
    Mutation(
        "labels/hidden by noise",
        "is_hidden = own < power",
        "is_hidden = own < power.max()",
        (*LABELS, "test_hidden_labels"),
    ),
    Mutation(
        "labels/hidden by the second noise",
        """ or "noise" in ping.meta:""",
        ":",
        ("test_hidden_labels",),
    ),
    Mutation(
        "labels/total of a third body",
        "total[bins + k] += rows[at + k]",
        "total[bins + k] = best[at + k] + rows[at + k]",
        LABELS,
    ),
    Mutation(
        "labels/background",
        'out[1 + self._index_of(name, "background")] = True',
        'out[self._index_of(name, "background")] = True',
        LABELS,
    ),
    Mutation(
        "hidden bodies/edges cut by the fan",
        "places = low[held, None] + places * (high - low)[held, None]",
        "places = places",
        (SEEN_ROD,),
    ),
    Mutation(
        "hidden bodies/points along edges",
        "n = POINTS // len(held)",
        "n = 1",
        (SEEN_ROD,),
    ),
    Mutation(
        "hidden bodies/gaps between beams",
        "return out & (np.searchsorted(received, u) % 2 == 1) if len(received) else out",
        "return out",
        ("test_adaptive::test_a_thin_body_between_two_beams_is_not_seen",),
    ),
    Mutation(
        "hidden bodies/above the water",
        "surface = np.array([[0.0, 0.0, -1.0, surface_z_m - SURFACE_MARGIN_M]]) @ body_pose",
        "pass",
        ("test_adaptive::test_a_body_above_the_water_asks_for_no_samples",),
    ),
    Mutation(
        "culling/faces in the water's surface",
        "self._surface_z_m - SURFACE_MARGIN_M - pose[2, 3]",
        "self._surface_z_m - pose[2, 3]",
        TRIANGLES,
    ),
    Mutation(
        "hidden bodies/sonar above the water",
        "if surface_z_m is not None and pose[2, 3] < surface_z_m:\n        surface =",
        "if surface_z_m is not None:\n        surface =",
        ("test_adaptive::test_only_a_sonar_in_the_water_does_not_see_what_is_above",),
    ),
    Mutation(
        "hidden bodies/nine samples around",
        "for row, column in product((-1, 0, 1), repeat=2)",
        "for row, column in [(0, 0)]",
        (CORNER,),
    ),
    Mutation("hidden bodies/samples of its own", "| is_own", "", (HIDDEN,)),
    Mutation(
        "hidden bodies/samples of its own beside the fan",
        "is_own &= _in_a_beam(",
        "_in_a_beam(",
        ("test_adaptive::test_a_body_of_which_an_edge_reaches_into_the_fan_is_not_looked_for",),
    ),
    Mutation(
        "visible bodies/gaps between beams",
        "if len(received_u) and np.searchsorted(received_u, uc) % 2 == 0:",
        "if False:",
        (BETWEEN_BOXES,),
    ),
    Mutation(
        "visible bodies/strips narrower than a sample",
        "np.maximum(widths, sector.u[1])[order]",
        "widths[order]",
        (RECEIVED_SAMPLES,),
    ),
    Mutation(
        "sequence/iterator that ends early",
        "_next_value(column, name, number)",
        "next(column, None)",
        (ENDS_EARLY,),
    ),
    Mutation(
        "sequence/name of what ended",
        "column, name, number",
        "column, FIELDS[name], number",
        (ENDS_EARLY,),
    ),
    Mutation(
        "sequence/where it ended",
        "(got {number}; pose {number},",
        "(got {number}; pose {number + 1},",
        (ENDS_EARLY,),
    ),
    Mutation(
        "sequence/iterator that goes on",
        "(column, name, number) for name, column in columns",
        "(column, name, number) for name, column in columns for _ in (0, 1)",
        ("test_sequence::test_an_iterator_may_go_on_beyond_the_poses",),
    ),
    Mutation(
        "sequence/lists of other lengths",
        "if counted and len(values) != len(poses):",
        "if False:",
        ("test_sequence",),
    ),
    Mutation(
        "meshes/vertices changed in place",
        "np.array_equal(mesh.vertices, before.vertices) and",
        "",
        (CHANGED_MESH,),
    ),
    Mutation(
        "meshes/faces changed in place",
        "and np.array_equal(mesh.faces, before.faces)",
        "",
        (CHANGED_MESH,),
    ),
    Mutation(
        "labels/faintest echoes",
        "FAINTEST = np.float32(1e-37)",
        "FAINTEST = np.float32(0.0)",
        ("test_labels::test_echoes_whose_inverse_no_float32_holds_have_no_label",),
    ),
    Mutation(
        "labels/far side lobes",
        "self._weights.column_response if self._far is None else self._far.column_response",
        "self._weights.column_response",
        ("test_labels::test_the_echo_of_a_body_beside_the_fan_is_received_by_far_side_lobes",),
    ),
    Mutation(
        "labels/columns joined beside the fan",
        "uneven = np.maximum.reduceat(off, begins) > UNEVEN * means",
        "uneven = np.maximum.reduceat(off, begins) > UNEVEN * response.max()",
        ("test_labels::test_joined_columns_keep_the_echo_of_a_thin_rod_beside_the_fan",),
    ),
    Mutation(
        "labels/response of columns at the seam",
        "(columns % n_columns).ravel(), self.weights.ravel(), n_columns",
        "np.abs(columns).ravel() % n_columns, self.weights.ravel(), n_columns",
        ("test_far_lobes::test_the_response_of_columns_is_the_sum_of_all_beams",),
    ),
    Mutation(
        "labels/response below nothing",
        "np.maximum(far, 0, out=far)",
        "far.sum()",
        ("test_far_lobes::test_the_response_of_columns_is_the_sum_of_all_beams",),
    ),
    Mutation(
        "far lobes/threads of LAPACK",
        'limit(limits=1, user_api="blas")',
        'limit(limits=2, user_api="blas")',
        ("test_far_lobes::test_lapack_has_one_thread_and_is_looked_for_once",),
    ),
    Mutation(
        "far lobes/search for LAPACK",
        "@cache\ndef _libraries()",
        "def _libraries()",
        ("test_far_lobes::test_lapack_has_one_thread_and_is_looked_for_once",),
    ),
    Mutation(
        "labels/interrupted weights",
        "self._weights[key] = make() if found",
        "self._weights[key] = None, None; self._weights[key] = make() if found",
        ("engine/test_interrupts::test_the_first_labels_are_interrupted_where_weights_are_found_and_kept",),
    ),
    # multipath by image sources
    Mutation(
        "multipath/slope across of single bounces",
        "((e0 + c0 * vc) * x_u - b0 * x)",
        "((e0 + c0 * vc) * x_u)",
        ("test_single_bounce",),
    ),
    Mutation("multipath/mean range", "2.0 / (length / q + range_there)", "1.0 / (length / q)", MULTIPATH),
    Mutation(
        "multipath/cosine of the other way",
        "echo[m] * side[m] / range_there",
        "echo[m] / range_there",
        MULTIPATH,
    ),
    Mutation(
        "multipath/handedness",
        "y = -y if from_image else -there_y[m]",
        "y = y if from_image else there_y[m]",
        MULTIPATH,
    ),
    Mutation(
        "multipath/behind the reflector",
        "(side[m] > 0.0) & (normal_x * x + normal_y * y + normal_z * z <= offset * q)",
        "side[m] > 0.0",
        MULTIPATH,
    ),
    Mutation(
        "multipath/spreading",
        "single_bounce * work[REFLECTED, m] * work[BISTATIC, m] * spreading * spreading",
        "single_bounce * work[REFLECTED, m] * work[BISTATIC, m] * spreading",
        MULTIPATH,
    ),
    Mutation(
        "multipath/two reflections",
        "work[ENERGY, m] *= work[REFLECTED, m] * work[REFLECTED, m]",
        "work[ENERGY, m] *= work[REFLECTED, m]",
        MULTIPATH,
    ),
    Mutation(
        "multipath/roughness both ways",
        "coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m) ** 2",
        "coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m)",
        (*MULTIPATH, "test_materials"),
    ),
    Mutation(
        "multipath/reflector of a turned body",
        "normal = pose[:3, :3] @ self.normal",
        "normal = self.normal @ pose[:3, :3]",
        MULTIPATH,
    ),
    Mutation(
        "multipath/estimate",
        "max(estimate, self.image_sampling.error_of(",
        "min(estimate, self.image_sampling.error_of(",
        MULTIPATH,
    ),
    Mutation(
        "multipath/error of bins",
        "return max(of_bins, _error_by_samples(",
        "return (_error_by_samples(",
        MULTIPATH,
    ),
    Mutation(
        "multipath/no comparison",
        "choice.error if coarser is None else echo.error_against(coarser)",
        "choice.error",
        MULTIPATH,
    ),
    Mutation(
        "multipath/never checked again",
        "is_new=False, is_due=check, finest=FINEST)",
        "is_new=False, finest=FINEST)",
        MULTIPATH,
    ),
    Mutation(
        "multipath/finer images compared with half as many",
        "step = 1 if own > 0 else 2",
        "step = 1",
        BY_IMAGES,
    ),
    Mutation(
        "multipath/four times the samples at most",
        "for n in range(14, 0, -1)",
        "for n in range(2, 0, -1)",
        BY_IMAGES,
    ),
    Mutation(
        "multipath/bodies that images alone see", "of_imaged <= WORST_BODY * allowed", "True", BY_IMAGES
    ),
    Mutation("multipath/small bodies", "fewest >= LEAST_ON_BODY * fewer and ", "", MULTIPATH),
    Mutation(
        "multipath/parallel planes",
        "(np.abs(offsets - offset) < tolerance_m)",
        "(np.abs(offsets - offset) < np.inf)",
        MULTIPATH,
    ),
    Mutation(
        "multipath/estimate of wider sectors",
        "(2 * t.tan_half_width / n) * (2 * half / n)",
        "(2 / n) * (2 * half / n)",
        ESTIMATE,
    ),
    Mutation(
        "multipath/estimate of one leg",
        "weight * math.sqrt(power), weight",
        "weight * power, weight",
        ESTIMATE,
    ),
    Mutation(
        "multipath/estimate beyond the range",
        "if seen[g] > 0.0 and length / seen[g] < range_max_m:",
        "if seen[g] > 0.0:",
        ESTIMATE,
    ),
    Mutation(
        "multipath/behind a body",
        "distance_ratio >= 1.0 - SAME_PLANE or not is_body",
        "True",
        ESTIMATE,
    ),
    Mutation(
        "multipath/samples that an image is expected to have",
        "solid_angle * (own_m / image_m) ** 2",
        "solid_angle",
        EXPECTED,
    ),
    Mutation("multipath/mean range of an image", "or (own_m + image_m) / 2 >= range_max_m", "", EXPECTED),
    Mutation(
        "multipath/bodies that nearly touch a reflector", "SAME_PLANE = 2e-3,", "SAME_PLANE = 2e-2,", EXPECTED
    ),
    Mutation("multipath/ceiling of an image", "up[3] - ceiling[3]", "up[3] + ceiling[3]", BY_THE_FLOOR),
    Mutation("multipath/ceiling", "& (up_0 - up_u * uc + up_v * vc <= top * q)", "", BY_THE_FLOOR),
    Mutation(
        "multipath/grazing angles",
        "is_met &= sine > 1e-6",
        "is_met &= sine > 0.1",
        ("test_multipath::test_a_floor_at_a_grazing_angle_returns_thrice_the_direct_echo",),
    ),
    Mutation(
        "multipath/weak reflectors",
        "MIN_REFLECTED = 1e-4",
        "MIN_REFLECTED = 0.1",
        ("test_multipath::test_the_reflection_coefficient_depends_on_the_angle",),
    ),
    Mutation(
        "cloud/lobes are lost",
        "total = min(mean + body.specular, 1.0)",
        "total = mean",
        ("test_simulator",),
    ),
    # small triangles, filled in on the CPU
    Mutation(
        "triangles/grid of the driver",
        "math.floor(columns[w] * GRID + 0.5)",
        "math.floor(columns[w] * GRID)",
        TRIANGLES,
    ),
    Mutation(
        "triangles/inside",
        "min(ey + e1 * x, fy + f1 * x, gy + g1 * x) >= 0.0",
        "min(ey + e1 * x, fy + f1 * x) >= 0.0",
        TRIANGLES,
    ),
    Mutation(
        "triangles/depth by column",
        "((qb - qa) * cj - (qc - qa) * bj) / determinant",
        "((qb - qa) * cj + (qc - qa) * bj) / determinant",
        TRIANGLES,
    ),
    Mutation(
        "triangles/perspective of normals",
        "(na * c0z + nb * c1z + nc * c2z) * over",
        "(na * c0z + nb * c0z + nc * c2z) * over",
        TRIANGLES,
    ),
    Mutation(
        "triangles/selection",
        "(left <= end) & (low <= high)",
        "(left < end) & (low <= high)",
        TRIANGLES,
    ),
    Mutation(
        "triangles/back faces",
        "patch.is_one_sided and area < 0.0",
        "patch.is_one_sided and area > 0.0",
        TRIANGLES,
    ),
    Mutation(
        "triangles/near plane",
        "1.0 / patch.near_m - form[0], -form[1], -form[2]",
        "form[0] - 1.0 / patch.near_m, form[1], form[2]",
        TRIANGLES,
    ),
    Mutation(
        "triangles/water's surface",
        "up * lattice_v[0] + plane[3] * q0",
        "up * lattice_v[0] - plane[3] * q0",
        TRIANGLES,
    ),
    Mutation(
        "triangles/specular lobe",
        "exponent = -0.5 * (1.0 - square) / (square * s2)",
        "exponent = -0.4 * (1.0 - square) / (square * s2)",
        TRIANGLES,
    ),
    Mutation(
        "triangles/a lobe taken as faint too early",
        "1.0 - 2.0 * FAINTEST * slope * slope",
        "1.0 - 0.1 * FAINTEST * slope * slope",
        TRIANGLES,
    ),
    Mutation(
        "triangles/no normals for faces",
        "if normal_forms.shape[0] > 0 and _has_normals(normals, start, f, faces):",
        "if normal_forms.shape[0] > 0 and normals[f, 0] > 2.0:",
        TRIANGLES,
    ),
    Mutation(
        "triangles/columns of a body",
        "ROW_REFLECTIVITY, ROW_STRENGTH, ROW_SLOPE = 12, 14, 15",
        "ROW_REFLECTIVITY, ROW_STRENGTH, ROW_SLOPE = 12, 15, 14",
        ("test_engines::test_the_rasteriser_reads_the_columns_that_scenes_write",),
    ),
    Mutation(
        "triangles/lobes of flat faces left out",
        "FLAT if has_lobe else FLAT_DIFFUSE",
        "FLAT_DIFFUSE",
        TRIANGLES,
    ),
    # culling and levels of detail
    Mutation("culling/box behind a plane", "beyond |= at < -reach", "beyond |= at < 0.0", CULLING),
    Mutation(
        "culling/level of detail",
        "enough = error_m[i] <= error_per_m * max(nearest, near_m)",
        "enough = error_m[i] <= 4 * error_per_m * max(nearest, near_m)",
        CULLING,
    ),
    Mutation(
        "culling/cone of normals",
        "math.sqrt(1 - cone[i, 3] * cone[i, 3]) * distance + radius",
        "math.sqrt(1 - cone[i, 3] * cone[i, 3]) * distance - radius",
        CULLING,
    ),
    Mutation(
        "culling/boxes beside the sonar",
        "t = (near_m - x[k]) / (x[o] - x[k])",
        "t = (near_m - x[o]) / (x[k] - x[o])",
        CULLING,
    ),
    Mutation(
        "culling/inside a body",
        "sonar = -(m[0, j] * m[0, 3] + m[1, j] * m[1, 3] + m[2, j] * m[2, 3])",
        "sonar = -m[j, 3]",
        CULLING,
    ),
    Mutation(
        "culling/at the face of a body",
        "bounds[n, 0, j] - CORNER * near_m < sonar < bounds[n, 1, j] + CORNER * near_m",
        "bounds[n, 0, j] < sonar < bounds[n, 1, j]",
        CULLING,
    ),
    Mutation(
        "levels/coarsest one",
        "while top.faces is not None and len(top.faces) > COARSEST_FACES:",
        "while False:",
        LEVELS,
    ),
    Mutation(
        "levels/one that is hardly coarser",
        "break top = fewer return",
        "top = fewer\n            break\n        top = fewer\n    return",
        LEVELS,
    ),
    Mutation("levels/rim of a mesh", "locked = fixed[used] | (lowest", "locked = (lowest", LEVELS),
    Mutation("levels/size of patches", "if len(joined.faces) <= MAX_PATCH_FACES:", "if True:", PATCHES),
    Mutation(
        "levels/cone of a patch without faces", "cone[number, 3] = -1.0", "cone[number, 3] = 1.0", PATCHES
    ),
    # the planner: adaptive sampling
    Mutation(
        "planner/rate of the error",
        "math.log2(max(error, 1e-9) / self.tolerance) * LEVELS_PER_HALF / ERROR_RATE",
        "math.log2(max(error, 1e-9) / self.tolerance) * LEVELS_PER_HALF / ERROR_RATE - 3",
        ADAPTIVE,
    ),
    Mutation("planner/plane of a grazing floor", "q > plane * IN_FRONT", "q > there * IN_FRONT", (GRAZING,)),
    Mutation("planner/glints", "found.samples * shares, found.echo", "found.samples, found.echo", ADAPTIVE),
    Mutation("planner/brighter bodies", "or brighter > CHECK_BRIGHTER", "", ADAPTIVE),
    Mutation(
        "planner/far pings follow",
        "return self._trigger.is_far(self.history.last, setup)",
        "return False",
        ADAPTIVE,
    ),
    Mutation(
        "planner/pings made ahead count",
        "upcoming.leave(_undelivered(in_flight))",
        "pass",
        ("test_sequence::test_pings_that_nobody_took_change_no_later_one",),
    ),
    Mutation(
        "sequence/numbers of later bodies",
        "return replace(setup, state=state, background",
        "return replace(setup, state=state, n_bodies=setup.n_bodies + n, background",
        ("test_sequence::test_pings_know_the_bodies_of_their_poses_whoever_makes_them",),
    ),
    Mutation(
        "ros/models of two steps",
        "return poses_of_parts(poses, self._parts_of)",
        "return poses",
        ("test_publisher::test_a_model_that_is_placed_takes_along_what_a_step_before_has_moved",),
    ),
    Mutation(
        "ros/order within a message",
        'came.sort(key=lambda one: one[0].count("::"))',
        "",
        ("test_message_inputs",),
    ),
    Mutation(
        "planner/pings that fail count",
        "run.sampler.history = history raise",
        "raise",
        ("test_adaptive::TestMoving::test_pings_after_one_that_failed_are_those_without_it",),
    ),
    Mutation(
        "weights/too few nodes",
        "GAUSS_NODES = (0.1, 3), (0.25, 4)",
        "GAUSS_NODES = (0.1, 2), (0.25, 3)",
        ("test_far_lobes",),
    ),
    Mutation(
        "planner/reviews by number",
        "self._is_much(moved, turned, brighter) or n_pings >= CHECK_EVERY",
        "self._is_much(moved, turned, brighter)",
        ADAPTIVE,
    ),
    Mutation(
        "planner/samples in the aperture",
        "(v2 <= high2 * u2)",
        "(v2 <= high2)",
        ADAPTIVE,
    ),
    Mutation(
        "planner/body out of the fan",
        "if abs(elevation_rad) - half_rad >= max_elevation_rad:",
        "if abs(elevation_rad) + half_rad >= max_elevation_rad:",
        ADAPTIVE,
    ),
    Mutation("planner/angle turned", "(float(trace) - 1) / 2", "(float(trace) + 1) / 4", ADAPTIVE),
    Mutation("planner/angle the sonar turned", "+ h * o + i * s", "+ h * o + i * w", ADAPTIVE),
    Mutation(
        "planner/bodies moved",
        "apart = after[:, :3, 3] - before[:, :3, 3]",
        "apart = after[:1, :3, 3] - before[:1, :3, 3]",
        ADAPTIVE,
    ),
    Mutation(
        "planner/height of rows",
        "rows = max(math.ceil(_aperture_deg(sonar) / sample_deg), fewest_rows(sonar))",
        "rows = fewest_rows(sonar)",
        ADAPTIVE,
    ),
    Mutation(
        "planner/bound of a body",
        "finer = (errors[worst] / (WORST_BODY * self.tolerance))",
        "finer = (errors[worst] / (2 * WORST_BODY * self.tolerance))",
        ADAPTIVE,
    ),
    Mutation("planner/bodies of few samples", "MIN_BODY_SAMPLES = 8", "MIN_BODY_SAMPLES = 0.5", JUDGED),
    Mutation("planner/bodies in two lattices", "DIFFERENCE_FACTOR = 1.37", "DIFFERENCE_FACTOR = 0.0", JUDGED),
    Mutation(
        "planner/mirrored lattice",
        "1 / COARSER), -SHEAR), -SHEAR)",
        "1 / COARSER), -SHEAR), SHEAR)",
        JUDGED,
    ),
    Mutation(
        "planner/samples of the mirrored lattice as wide as columns",
        "1 / COARSER), -SHEAR), -SHEAR)",
        "1 / COARSER), SHEAR), -SHEAR)",
        ("test_adaptive::test_samples_as_wide_as_whole_columns_take_thin_upright_parts_by_their_width",),
    ),
    Mutation("planner/difference of two pings", "\nERROR_FACTOR = 1.4", "\nERROR_FACTOR = 0.7", JUDGED),
    Mutation(
        "planner/weak bodies",
        "MIN_ECHO_SHARE = 5e-4",
        "MIN_ECHO_SHARE = 5e-3",
        ("test_adaptive::test_a_body_counts_if_its_echo_is_strong_or_is_not_known",),
    ),
    Mutation("planner/poses of a plan", "MAX_POSES = 24", "MAX_POSES = 2", ADAPTIVE),
    Mutation(
        "planner/rate of a body's difference",
        "share_of_difference(coarser, BODY_ERROR_RATE)",
        "share_of_difference(coarser, ERROR_RATE)",
        ADAPTIVE,
    ),
    Mutation(
        "planner/samples of a body to levels",
        "LEVELS_PER_HALF / 2 * math.log2(finer)",
        "LEVELS_PER_HALF * math.log2(finer)",
        ADAPTIVE,
    ),
    Mutation(
        "planner/unevenness along rows",
        "beside2 += (mine[i] - mine[i - uint64(1)]) ** 2",
        "beside2 += 0.0",
        ADAPTIVE,
    ),
    Mutation(
        "planner/edges that are too many",
        "held[:: math.ceil(len(held) / POINTS)]",
        "held[:POINTS]",
        ADAPTIVE,
    ),
    Mutation(
        "planner/bodies that get darker",
        "np.where(high > low, high / np.maximum(low, 1e-12), 1.0)",
        "np.where(high > low, other / np.maximum(own, 1e-12), 1.0)",
        ADAPTIVE,
    ),
    Mutation("planner/echo that gets weaker", "abs(total - before) >", "(total - before) >", ADAPTIVE),
    Mutation("planner/view of bubbles", "state.bubbles, setup.gain", "setup.gain", ADAPTIVE),
    Mutation(
        "planner/echo of a search",
        "return FoundLevel(*found[level], finest)",
        "return FoundLevel(found[level][0], tried.echo.total, finest)",
        LEVEL_SEARCH,
    ),
    Mutation(
        "planner/bodies of a coarser view",
        "counts & (tried.counts.samples < MAX_COMPARED_SAMPLES)",
        "counts & (tried.counts.samples > MAX_COMPARED_SAMPLES)",
        ("test_adaptive::test_of_a_coarser_view_those_bodies_alone_are_counted_that_it_is_compared_by",),
    ),
    Mutation(
        "batch/threads of workers",
        "max(1, count_cores() // len(devices))",
        "count_cores()",
        ("test_runs::test_processes_share_the_cores",),
    ),
    Mutation(
        "batch/threads that the user asks for",
        'if "NUMBA_NUM_THREADS" not in os.environ:',
        "if count:",
        ("test_runs::test_processes_share_the_cores",),
    ),
    Mutation(
        "planner/a plan that is not met",
        "met=all(plan.met for plan in plans)",
        "met=any(plan.met for plan in plans)",
        LEVEL_SEARCH,
    ),
    Mutation(
        "planner/samples that fit again",
        "finest = self.search.finest if level < choice.level else choice.finest",
        "finest = choice.finest",
        (MOVED_LEVEL,),
    ),
    Mutation(
        "planner/samples that do not fit alone",
        "self.search.finest if plan.met else plan.level",
        "self.search.finest",
        (AFTER_ONE_ALONE,),
    ),
    Mutation(
        "planner/costs of another place",
        "costs = (float(plan.n_samples + self._fixed_cost),)",
        "costs = *history.costs, float(plan.n_samples + self._fixed_cost)",
        (AFTER_ONE_ALONE,),
    ),
    Mutation(
        "planner/samples on the glint of a round body",
        "found.samples * shares, found.echo",
        "found.samples, found.echo",
        (WEIGHED,),
    ),
    Mutation(
        "planner/bodies that move",
        "sphere, body_pose = self._extents.sphere_about(body), state.poses[body - 1]",
        "sphere, body_pose = self._extents.sphere_about(body), one.pose",
        (COUNTED,),
    ),
    Mutation(
        "planner/bodies beside the fan",
        "return reception_of(stage.beamformer, self._reach_rad",
        "return reception_of(stage.beamformer, 0.0",
        (BESIDE_FAN,),
    ),
    Mutation(
        "planner/image sources of the hardest pose",
        "min(least, found.halvings)",
        "found.halvings",
        ("test_planning",),
    ),
    Mutation(
        "planner/image sources of a plan before",
        "images.release() for setup in evenly_picked",
        "for setup in evenly_picked",
        ("test_planning",),
    ),
    Mutation(
        "noise/cells of one column of the sea",
        "for n in (cell_x, cell_y, chunk)",
        "for n in (cell_x, cell_x, chunk)",
        NOISE,
    ),
    Mutation(
        "noise/interference under a TVG",
        "self._mean_power(noise.interference_db)",
        "self._mean_power(noise.interference_db) / self._tvg",
        NOISE,
    ),
    Mutation(
        "noise/amplitude of the echo", "np.sqrt(intensity, out=total[:, 0])", "total[:, 0] = intensity", NOISE
    ),
    Mutation(
        "noise/sign over the seam of a circle",
        "is_split = is_circle and elements % 2 == 0",
        "is_split = False",
        ("test_speckle::test_fields_go_on_over_the_seam_of_a_full_circle",),
    ),
    Mutation(
        "noise/power of a field",
        "np.multiply(amplitude, np.float32(np.sqrt(0.5)), dtype=np.float32)",
        "np.multiply(amplitude, np.float32(0.5), dtype=np.float32)",
        NOISE,
    ),
    Mutation(
        "noise/mean of the texture",
        "np.exp(np.interp(np.log(x), np.log(decay[known]), grid[known])) / shape",
        "np.exp(np.interp(np.log(x), np.log(decay[known]), grid[known])) / (shape + 0.1)",
        NOISE,
    ),
    Mutation("noise/thermal noise", "-15 + 20 * np.log10(", "-15 + 17 * np.log10(", NOISE),
    Mutation("noise/directivity index, one way", "4 * math.pi / receive_sr", "4 * math.pi / echo_sr", NOISE),
    Mutation(
        "noise/pulse of another sonar",
        "PULSE_S * sound_speed_m_s / 2 / bin_size_m",
        "PULSE_S * sound_speed_m_s / bin_size_m",
        NOISE,
    ),
    Mutation(
        "noise/aperture that moves aside",
        "2 * across_m / spacing_m",
        "across_m / spacing_m",
        NOISE,
    ),
    Mutation(
        "noise/phase of cross-faded cells",
        "(4 * np.pi / shape.wavelength_m * along_m)",
        "(2 * np.pi / shape.wavelength_m * along_m)",
        NOISE,
    ),
    Mutation(
        "noise/phase of waves",
        "c * ak - s * bk",
        "c * ak + s * bk",
        NOISE,
    ),
    Mutation("noise/waves of the second beam", "w = wave - from_other", "w = wave - from_one", NOISE),
    Mutation("noise/window between nodes", "(KAISER / 2) ** n", "(KAISER / 4) ** n", NOISE),
    Mutation(
        "noise/pattern over white nodes", "aperture_field(off / OVERSAMPLING", "aperture_field(off", NOISE
    ),
    Mutation("noise/transform of the window", "* root / np.sinh(root)", "* root", NOISE),
    Mutation(
        "noise/mirrored nodes",
        "np.subtract(even, odd, out=to[",
        "np.add(even, odd, out=to[",
        NOISE,
    ),
    Mutation(
        "noise/cross-talk keeps the sum",
        "share / (1 + (len(beams) - 1) * share)",
        "share / (1 + len(beams) * share)",
        CROSS_TALK,
    ),
    Mutation("noise/texture of bodies", "/ np.sqrt(shapes)", "/ np.sqrt(np.minimum(shapes, 1.0))", NOISE),
    Mutation("noise/deviation of the texture", "4.0 * math.log2(ratio)", "2.0 * math.log2(ratio)", NOISE),
    Mutation("noise/set of beams", "out[first::spacing] +=", "out[first:] +=", CROSS_TALK),
    Mutation(
        "noise/decay of the ring-down",
        "ring_down_decay_db_m * r, -300",
        "ring_down_decay_db_m, -300",
        RING_DOWN,
    ),
    Mutation("noise/period at any heading", "(most - 1) * step", "(len(numbers) - 1) * step", NOISE),
    Mutation(
        "noise/period longer than the fan",
        "min(2 * np.pi / (1.2 * span",
        "min(2 * np.pi / (0.0 * span",
        NOISE,
    ),
    # volume reverberation
    Mutation(
        "volume/water behind surfaces",
        "even_response[:, None] - before",
        "even_response[:, None] + 0 * before",
        VOLUME,
    ),
    Mutation("volume/half a bin", "- covered / 2", "- covered", VOLUME),
    Mutation(
        "volume/surface of the water",
        "is_surface = depth_inverse >",
        "is_surface = 0 * depth_inverse >",
        VOLUME,
    ),
    Mutation("volume/rolled surface", "x - y * u + z * v", "x + y * u + z * v", VOLUME),
    Mutation(
        "surface/mean of steep bins",
        "own = np.pi * backscatter(np.arcsin(sines)) / sines**2",
        "own = 1.0 * means",
        SURFACE,
    ),
    Mutation("surface/nodes in a bin", "(NODES + 1) / 2", "(NODES + 1) / 4", SURFACE),
    Mutation(
        "surface/Lambert's law",
        "(met.depth_inverse, *met.slopes, surface.height_m)",
        "(met.depth_inverse, *met.slopes, 1.0)",
        SURFACE,
    ),
    Mutation("surface/labels", "_clear(labels, direct, other)", "_clear(labels, direct, 0 * other)", SURFACE),
    Mutation(
        "surface/height of the wind", "AT_19_5_M * wind_speed_m_s", "wind_speed_m_s", ("test_sea_surface",)
    ),
    Mutation("pulse/side lobes", '"hamming": 1.1e-4', '"hamming": 1e-3', ("test_pulse",)),
    Mutation(
        "surface/waves end the reflection",
        "max(scene.surface_roughness_m, wave_height_m)",
        "scene.surface_roughness_m",
        SURFACE,
    ),
    Mutation(
        "volume/nearer than the first bin",
        "plane[..., 0] * first_m > length",
        "plane[..., 0] * first_m > 1e9 * length",
        VOLUME,
    ),
    Mutation(
        "volume/transmit beam",
        "self.weigh(columns, NO_GAIN).intensity[:, 0].astype(np.float64)",
        "np.ones(len(self._tiles[0]) * 4)",
        VOLUME,
    ),
    Mutation(
        "noise/mean of looks",
        "intensity /= np.float32(noise.looks)",
        "intensity /= np.float32(noise.looks + 1)",
        NOISE,
    ),
    Mutation(
        "noise/coherent echo that speckles, too",
        "np.maximum(intensity - part, 0, out=intensity)",
        "np.maximum(intensity, 0, out=intensity)",
        ("test_coherent_echo", "test_scatterers"),
    ),
    Mutation(
        "noise/diffuse echo among the lobes",
        "lobes=state.without_diffuse_echo()",
        "lobes=state",
        ("test_coherent_lobes",),
    ),
    Mutation("noise/interpolation of beams", "np.sinc(off) * window", "window", NOISE),
    Mutation(
        "scatterers/volume of a bin", "density_m3 * r**2 * size_m", "density_m3 * r * size_m", SCATTERERS
    ),
    Mutation(
        "scatterers/strength over elevation",
        "np.sqrt(strength / rate[k])",
        "np.sqrt(1 / rate[k])",
        SCATTERERS,
    ),
    Mutation(
        "scatterers/from where there are many",
        "per_rad * beam_angle_rad(",
        "0 * per_rad * beam_angle_rad(",
        SCATTERERS,
    ),
    Mutation("scatterers/ends of the pulse", 'mode="edge"', 'mode="constant"', SCATTERERS),
    Mutation(
        "scatterers/new in each ping",
        'self._stream("scatterers")',
        'stream(self._seed, 0, "scatterers")',
        SCATTERERS,
    ),
    Mutation(
        "noise/common to channels, behind the array",
        "np.where(np.cos(azimuth) > 0, group",
        "np.where(True, group",
        COMMON,
    ),
    Mutation(
        "noise/common to channels, width", "np.outer(pattern, self", "np.outer(pattern**2, self", COMMON
    ),
    # the store of a batch
    Mutation("store/second of the fields that vary", "column(group, k)", "column(group)", STORE),
    Mutation("store/blocks of the table", "first += len(block) - rest", "first += len(block)", STORE),
    Mutation(
        "store/bodies that stay",
        "request.bodies.get(name, known[name].pose)",
        "request.bodies.get(name)",
        STORE,
    ),
    Mutation("store/rounding of a mantissa", "np.uint32(1 << (drop - 1))", "np.uint32(0)", ENCODING),
    Mutation(
        "store/place of a shard",
        "first // array.shards[0]",
        "first // array.chunks[0]",
        STORE,
    ),
    Mutation(
        "store/shards of nothing", '{"write_empty_chunks": True}', '{"write_empty_chunks": False}', STORE
    ),
    Mutation(
        "store/order of metadata",
        "folder.put_json(name, json.loads(folder.get(name)))",
        "folder.get(name)",
        STORE,
    ),
    Mutation("store/fill of a shard", '{"fill_value": array.fill_value,', "{", STORE),
    Mutation(
        "store/repair of metadata", "if folder.get(name) != data:", "if folder.get(name) is None:", STORE
    ),
    Mutation(
        "store/bodies of later scenes",
        "np.where(found > 0, found + np.asarray(first, body_dtype), found)",
        "found + np.asarray(first, body_dtype)",
        STORE,
    ),
    Mutation(
        "store/rounding of labels",
        "np.int32(np.rint(value * per_step))",
        "np.int32(value * per_step)",
        ("test_store::test_the_greatest_number_is_told_from_a_missing_one",),
    ),
    Mutation(
        "store/pings of a chunk",
        "np.gcd(CHUNK_PINGS, part)",
        "min(CHUNK_PINGS, part)",
        STORE,
    ),
    Mutation(
        "store/azimuths as coordinates", "{**array.attributes, **coordinates}", "array.attributes", STORE
    ),
    # records of a batch
    Mutation("records/checksum", "if record_bytes(values) == data:", "if values is not None:", RECORDS),
    Mutation(
        "records/batch of a part",
        "if record.batch != manifest.identity:",
        "if record.batch is None:",
        RECORDS,
    ),
    Mutation(
        "records/manifest made again", "if finished != {manifest.identity}:", "if not finished:", RECORDS
    ),
    Mutation(
        "records/system of a worker",
        "self._system.check(self._batch.manifest.system, self.folder.url)",
        "self._system.check(self._system, self.folder.url)",
        RECORDS,
    ),
    Mutation("records/flush of all files", "sync_file_system(self.root)", "sync(self.root)", POWER),
    Mutation("records/flush of a name", "sync(str(target.parent))", "sync(self.root)", POWER),
    # the guard of a host's OpenGL state
    Mutation(
        "guard/objects that are gone",
        "saved if exists is None or exists(saved) else 0",
        "saved",
        GUARD,
    ),
    Mutation(
        "guard/masks of colours",
        "gl.glColorMaski(k, *state.color_masks[k])",
        "gl.glColorMaski(k, *state.color_masks[0])",
        GUARD,
    ),
    Mutation(
        "guard/alignment",
        "4 if name in ALIGNMENT else 0) for name in PACK",
        "4 if name in ALIGNMENT else 0) for name in PACK[:-1]",
        GUARD,
    ),
    Mutation(
        "guard/clip control",
        "gl.glClipControl(*state.clip_control)",
        "gl.glClipControl(*state.clip_control[::-1])",
        GUARD,
    ),
    Mutation(
        "guard/switches",
        "gl.glEnable if capability in (MULTISAMPLE, DITHER) else",
        "gl.glEnable if capability in (DITHER,) else",
        GUARD,
    ),
    # the SDF reader
    Mutation(
        "sdf/quaternion",
        "(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w))",
        "(1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z + y * w))",
        SDF,
    ),
    Mutation(
        "sdf/placement frame",
        "matrix @ np.linalg.inv(frame.scope.find(frame.placement, frame.location))",
        "matrix @ frame.scope.find(frame.placement, frame.location)",
        SDF,
    ),
    Mutation(
        "sdf/visuals that say how they echo",
        "visuals if not collisions or only_visuals_specified else collisions",
        "visuals if not collisions else collisions",
        SDF,
    ),
    Mutation(
        "sdf/meshes of other sizes are one",
        "self._meshes[key], (*key, *scale)",
        "self._meshes[key], key",
        ("test_sdf::test_models_of_one_mesh_share_it",),
    ),
    Mutation(
        "load/copies of other sizes are one",
        "changes = tuple(np.round((stretch - np.eye(3)) * (reach_m / SAME_SIZE_M)).flat)",
        "changes = (1,)",
        ("test_load::test_copies_in_a_mesh_file_of_one_size_share_their_mesh",),
    ),
    Mutation(
        "load/shapes under rotations that are rounded are copied",
        "if not any(changes): return shape",
        "pass",
        ("test_load::test_a_node_whose_rotation_is_rounded_has_one_as_pose_and_the_shape_as_it_is",),
    ),
    Mutation(
        "sdf/repeated elements",
        "for tag in ONCE if len(element.findall(tag)) > 1",
        "for tag in ONCE if len(element.findall(tag)) > 2",
        ("test_sdf::test_where_one_element_may_stand_the_first_is_read_and_others_are_told_of",),
    ),
    Mutation(
        "load/mirrored copies are turned",
        "rotation @ mirror, mirror @ stretch",
        "rotation @ mirror, stretch",
        ("test_load::test_copies_in_a_mesh_file_of_one_size_share_their_mesh",),
    ),
    Mutation("sdf/newest version", "max(names, key=lambda n: n[0])", "min(names, key=lambda n: n[0])", SDF),
    Mutation(
        "sdf/order of the sonar's signs",
        "rank = 0\n            elif by_sensor:\n                rank = 1",
        "rank = 1\n            elif by_sensor:\n                rank = 0",
        SDF,
    ),
    Mutation(
        "sdf/precedence of a plugin",
        "self._camera() | self._scan() | self._plugin()",
        "self._plugin() | self._scan() | self._camera()",
        SENSORS,
    ),
    Mutation(
        "sdf/bin of a bandwidth",
        "(sound_speed_m_s or PLUGIN_SOUND_SPEED_M_S) / (2 * bandwidth_hz)",
        "(sound_speed_m_s or PLUGIN_SOUND_SPEED_M_S) / bandwidth_hz",
        SENSORS,
    ),
    Mutation(
        "sdf/custom sensor named after a DVL",
        "                continue\n            if any(",
        "                by_sensor = by_model = False\n            if any(",
        SENSORS,
    ),
    Mutation(
        "sdf/side of a scan", "middle_deg + offset for offset", "offset - middle_deg for offset", SENSORS
    ),
    Mutation("sdf/name in a merged model", "if scope.holds(head):", "if head in scope.links:", SDF),
    Mutation("sdf/pose of a merged model", "model, model_from_inner)", "model, model_from_scope)", SDF),
    Mutation("sdf/shapes at fault", "elements and len(elements) == len(among)", "elements", SDF),
    Mutation(
        "sdf/tags in capitals", "get_close_matches(tag.lower(), read", "get_close_matches(tag, read", SDF
    ),
    Mutation("sdf/body of a model", "if name == link.model:", "if False:", SDF),
    Mutation(
        "sdf/one link",
        "if n_with_geometry[link.model] == 1",
        "if n_with_geometry[link.model] >= 1",
        SDF,
    ),
    Mutation(
        "world/model without its links' places",
        "pose if pose is None else pose @ at for part, at",
        "pose for part, at",
        ("test_moving_bodies",),
    ),
    Mutation(
        "ros/home of a model",
        "else model_from_world @ thing.pose",
        "else thing.pose",
        ("test_message_inputs",),
    ),
    Mutation(
        "ros/model without bodies",
        "for model in scene.models if (parts := scene.parts_of(model))",
        "for model in scene.models if (parts := scene.parts_of(model)) is not None",
        ("test_message_inputs",),
    ),
    Mutation(
        "cli/handler that stays",
        "signal.signal(number, handler or signal.SIG_DFL)",
        "signal.signal(number, signal.SIG_IGN)",
        ("test_sigterm",),
    ),
    # counts and pictures
    Mutation("counts/full scale", "flat *= full**-law.exponent", "flat *= full**law.exponent", COUNTS),
    Mutation(
        "counts/side of the gain",
        "law.low_db - law.gain_db, law.high_db",
        "law.low_db + law.gain_db, law.high_db",
        COUNTS,
    ),
    Mutation(
        "counts/rounding",
        "np.float32(self.full_scale) + np.float32(0.5)",
        "np.float32(self.full_scale)",
        COUNTS,
    ),
    Mutation("counts/bins without echo", "np.count_nonzero(flat > 0)", "np.count_nonzero(flat >= 0)", COUNTS),
    Mutation("counts/one kind of gain", "{**reset, **values}", "values", COUNTS),
    Mutation(
        "counts/gain of the averaged bins",
        "polar = law.share(polar)",
        "polar = (counts or law).share(polar)",
        ("test_fan_image",),
    ),
    Mutation(
        "counts/port first",
        "np.ascontiguousarray(counts[::-1].T",
        "np.ascontiguousarray(counts.T",
        ("test_bag",),
    ),
    # boxes about bodies
    Mutation("boxes/bright echoes", "(1 << 14) - 1", "(1 << 13) - 1", BOXES),
    Mutation("boxes/gap across the seam", "for i in range(2 * n):", "for i in range(n):", BOXES),
    Mutation(
        "boxes/numbers beyond the entries",
        "<= int(body_id.max()) < n_numbers",
        "<= int(body_id.max())",
        BOXES,
    ),
    Mutation(
        "boxes/numbers below zero",
        "0 <= int(body_id.min()) <= int(body_id.max()) <",
        "int(body_id.max()) <",
        BOXES,
    ),
    Mutation("boxes/whole numbers", 'body_id.dtype.kind not in "iu" or', "", BOXES),
    Mutation("boxes/faint ends", "LEFT_OUT_OF = 200", "LEFT_OUT_OF = 100", BOXES),
    Mutation("boxes/without noise", "quiet = ping if quiet is None else quiet", "quiet = ping", BOXES),
    Mutation("boxes/across the seam", "gap, (i + 1) % n", "gap, 0", BOXES),
    Mutation("boxes/shape of labels", "or body_id.shape != ping.intensity.shape:", ":", BOXES),
    # other formats of scenes
    Mutation(
        "urdf/a DVL is no imaging sonar",
        'if any(word in f"{names[0]} {custom_kind}".lower() for word in OTHER_SONARS):',
        "if False:",
        ("test_urdf",),
    ),
    Mutation("xacro/functions", "if not isinstance(node, NODES):", "if False:", ("test_urdf",)),
    Mutation(
        "mujoco/groups",
        "return model.geom_group[geom] <= VISIBLE_GROUPS and rgba[3] > 0",
        "return rgba[3] > 0",
        ("test_mujoco_model",),
    ),
    Mutation("mujoco/rows of a height field", "heights[::-1] * z_m", "heights * z_m", ("test_mujoco_model",)),
    Mutation("ros/late pings", "number + 1, time_ns", "self._number + 1, time_ns", ("test_ping_schedule",)),
    Mutation("ros/jumps back", "time_ns < self._last_ns - self._period_ns", "False", ("test_ping_schedule",)),
    Mutation("ros/short bags", "ahead_ns < -BACK_NS", "False", ("test_ping_schedule",)),
    Mutation(
        "ros/clock before a ping",
        "if is_due or self._clock_ns is None",
        "if self._clock_ns is None",
        ("test_publisher",),
    ),
    Mutation(
        "ros/bodies of messages",
        "is_own = self._is_own_pose and self._are_own_bodies",
        "is_own = self._is_own_pose",
        ("test_publisher",),
    ),
    Mutation(
        "ros/length of a quaternion",
        "if not abs(square - 1) <= NORM_TOLERANCE:",
        "if False:",
        ("test_message_inputs",),
    ),
    Mutation(
        "ros/shapes of a body", "and np.array_equal(other.pose, body.pose)", "", ("test_message_inputs",)
    ),
    Mutation(
        "ros/angles of raw beams",
        '-to_port if y_sign == "port" else to_port',
        "to_port",
        ("test_publisher",),
    ),
    Mutation(
        "ros/tilt of points",
        "points @ self._sonar.sonar_from_head[:3, :3].T.astype(np.float32)",
        "points",
        ("test_publisher",),
    ),
    Mutation(
        "live/notes of bodies that moved",
        "if request.bodies is not last_bodies or not np.array_equal(pose, last_pose):",
        "if not np.array_equal(pose, last_pose):",
        ("test_session::test_a_sonar_inside_a_body_or_in_the_air_is_told_in_each_frame_in_which_it_rests",),
    ),
    Mutation(
        "live/range of another sonar", "min(range_m, sonar.range_limit_m)", "range_m", ("test_view_parts",)
    ),
    Mutation("live/outline over its body", "np.uint8)) > closed", "np.uint8)) > 0", ("test_view_parts",)),
    Mutation(
        "live/picture on the lower face",
        "pose(pitch=-self.elevation_rad) @ flat",
        "pose(pitch=self.elevation_rad) @ flat",
        ("test_view_parts",),
    ),
    Mutation(
        "live/time of a pose",
        "TimedPose(self._track.at(position_s), position_s)",
        "TimedPose(self._track.at(position_s), self._position_now())",
        ("test_sonar_motion",),
    ),
    Mutation(
        "live/pings made up for",
        "(now_s if now_s - due_s > period_s else due_s)",
        "due_s",
        ("test_ping_thread",),
    ),
    Mutation(
        "live/wait after a ping that failed",
        "due_s = time.monotonic() + RETRY_S",
        "pass",
        ("test_ping_thread",),
    ),
    Mutation(
        "live/settings that came meanwhile",
        "if settings == self.settings:",
        "if True:",
        ("test_settings_trial",),
    ),
    Mutation(
        "live/sign of new settings",
        "is_pending = state.settings is not frame.settings",
        "is_pending = False",
        ("test_page_messages",),
    ),
    Mutation(
        "live/welcome of a browser that has gone",
        "if client.client_id not in self.server.get_clients():",
        "if False:",
        ("test_page_messages::test_a_browser_that_has_gone_before_its_turn_is_passed_over",),
    ),
    Mutation(
        "live/pointer at a selected body", "node.remove_click_callback()", "pass", ("test_page_messages",)
    ),
    Mutation(
        "ros/readiness of a slow ping", "is_ready=self._work is None", "is_ready=True", ("test_publisher",)
    ),
    Mutation(
        "ros/port of a closed server",
        "if not wait_until_free(self._host, port, end_s - time.monotonic()):",
        "if False:",
        ("test_foxglove",),
    ),
    Mutation(
        "live/unit of a start time",
        "int(self.time_s * NANOSECONDS) & 0xFFFFFFFF",
        "int(self.time_s * 1e6) & 0xFFFFFFFF",
        ("test_oculus",),
    ),
    Mutation(
        "misuse/pipe that nobody writes to",
        "if pipe and is_open_pipe:",
        "if pipe and is_pipe:",
        ("test_special_files",),
    ),
    Mutation(
        "misuse/output in the place of a device",
        "if path.exists() and not path.is_file():",
        "if path.is_dir():",
        ("test_doctor",),
    ),
    Mutation(
        "misuse/mesh changed in place",
        """object.__setattr__(kept, "surface", self._copy(body.surface))""",
        "pass",
        ("test_moving_bodies",),
    ),
    Mutation(
        "misuse/copy of a mesh that has changed since",
        "if before is not None and _is_same(mesh, before):",
        "if before is not None:",
        ("test_moving_bodies",),
    ),
    Mutation(
        "misuse/warning of bodies that a generator places",
        "self.n_changes += has_changed and not self._is_taking_request",
        "self.n_changes += has_changed",
        ("test_sequence",),
    ),
    Mutation(
        "world/own pose of a part of a model",
        "return out | own",
        "return own | out",
        ("test_moving_bodies",),
    ),
    Mutation(
        "planner/rows between those that are counted",
        "echo[i] *= every * gain",
        "echo[i] *= gain",
        ("test_adaptive::test_the_echo_of_a_body_and_its_unevenness_are_those_of_its_samples",),
    ),
    Mutation(
        "kernels/whole numbers of a sonar",
        "float(sonar.range_min_m), float(sonar.range_max_m), sonar.bin_size_m",
        "sonar.range_min_m, sonar.range_max_m, sonar.bin_size_m",
        ("test_simulator::test_whole_numbers_of_a_sonar_compile_nothing_more",),
    ),
    Mutation(
        "sonar inside a body/later pings",
        "self._has_looked = True",
        "self._has_looked = False",
        ("test_simulator::test_the_first_ping_of_a_sonar_inside_a_body_warns",),
    ),
    Mutation(
        "run/a job of this thread behind others",
        "awaited = [job for job in self._in_flight if job not in beside]\n            for job in awaited:",
        "awaited = [job for job in self._in_flight if job not in beside]\n            for job in ():",
        ("test_sequence::test_a_ping_inside_a_job_is_refused_before_any_other_job_is_awaited",),
    ),
    Mutation(
        "worker/memory with each change of sampling",
        "self._stages.settle(stage.fan.n_samples)",
        "self._stages.drop_large()",
        ("test_sequence::test_a_worker_keeps_its_memory_as_samples_become_fewer_and_more",),
    ),
    Mutation(
        "obstruction/sphere in the frame of the body",
        "centre = sonar_from_body[:3, :3] @ sphere.centre + sonar_from_body[:3, 3]",
        "centre = sphere.centre",
        ("test_adaptive",),
    ),
    Mutation(
        "obstruction/sectors beside a body",
        "np.flatnonzero(~_are_beside(frusta, Sphere(centre, sphere.radius_m)))",
        "np.arange(len(frusta))",
        ("test_adaptive",),
    ),
    Mutation(
        "sequence/pings by the caller",
        "if jobs[0].is_over:",
        "if True:",
        ("test_sequence::test_the_caller_makes_pings_while_it_waits_for_the_first",),
    ),
    Mutation(
        "sequence/small pings",
        "self.are_small = not has_more and view.n_samples < FEW_SAMPLES",
        "self.are_small = False",
        ("test_sequence",),
    ),
    Mutation(
        "sequence/labels of small pings",
        "has_more = has_lobes or has_echoes or received.labels is not None",
        "has_more = has_lobes or has_echoes",
        ("test_sequence",),
    ),
    Mutation(
        "sequence/look-ahead of small pings",
        "return threads.most * (threads.ahead + 1) if _makes_here(upcoming, threads) else threads.most",
        "return threads.most",
        ("test_sequence",),
    ),
    Mutation(
        "misuse/bodies placed late",
        "if world.n_changes != n_changes and n_ahead and not has_warned:",
        "if world.n_changes != n_changes and not has_warned:",
        ("test_sequence",),
    ),
    Mutation(
        "live/first ping of an emulator",
        "simulation.submit(head.ping, sonar, acoustics, time_s=0.0, number=0).result()",
        "",
        ("test_emulate",),
    ),
    Mutation(
        "samples/levels that halve their width",
        "COARSEST_DEG * 2 ** (-level / LEVELS_PER_HALF)",
        "COARSEST_DEG * 2 ** (-level / 3)",
        SAMPLING,
    ),
    Mutation(
        "samples/level for a tolerance",
        "(0.02 / tolerance) ** (1 / ERROR_RATE)",
        "(0.02 / tolerance) ** ERROR_RATE",
        SAMPLING,
    ),
    Mutation(
        "fan/columns of a transmit beam",
        "beams.transmit_width_rad / COLUMNS_PER_TRANSMIT_BEAM",
        "beams.transmit_width_rad",
        ("test_fan",),
    ),
    Mutation(
        "fan/columns of a table",
        "spacing = np.diff(sonar.azimuth_rad).min(initial=span_rad)",
        "spacing = np.diff(sonar.azimuth_rad).max(initial=0)",
        ("test_fan",),
    ),
    Mutation(
        "fan/whole columns of samples",
        "multiple * math.ceil(plane / widest / multiple)",
        "math.ceil(plane / widest)",
        ("test_fan",),
    ),
    Mutation(
        "fan/samples as wide as columns",
        "return self._stages.fitted(sampling_at(self._sonar, level))",
        "return sampling_at(self._sonar, level)",
        ("test_adaptive::test_samples_as_wide_as_whole_columns_take_thin_upright_parts_by_their_width",),
    ),
    Mutation(
        "fan/columns beyond the reach",
        "np.where((low < reach_rad - 1e-12) & (high > 1e-12 - reach_rad), high, low)",
        "high",
        ("test_far_lobes",),
    ),
    Mutation("fan/columns of the mirror image", "KEPT_COLUMNS = 2", "KEPT_COLUMNS = 1", ("test_stage",)),
    Mutation(
        "fan/samples of further side lobes",
        "coarser = SKIRTS_COARSER * 2**number",
        "coarser = SKIRTS_COARSER",
        ("test_fan",),
    ),
    Mutation(
        "fan/rows of fitted samples",
        "round(sampling.rows * wider)",
        "round(sampling.rows / wider)",
        ("test_fan",),
    ),
    Mutation(
        "fan/fewest rows of fitted samples",
        "max(round(sampling.rows * wider), min(sampling.rows, fewest_rows(sonar)))",
        "round(sampling.rows * wider)",
        ("test_fan",),
    ),
    Mutation(
        "fan/most fitted samples of a beam",
        "min(sampling.columns_per_beam / wider, MAX_COLUMNS_PER_BEAM)",
        "sampling.columns_per_beam / wider",
        ("test_fan",),
    ),
    Mutation(
        "fan/fitted samples narrower than a column", "if n % self.n_columns(n) == 0", "if True", ("test_fan",)
    ),
    Mutation(
        "fan/columns that are even in tangents",
        "np.arctan(math.tan(half_width_rad) * np.linspace(-1, 1, n_columns + 1)[:-1])",
        "half_width_rad * np.linspace(-1, 1, n_columns + 1)[:-1]",
        ("test_fan",),
    ),
    Mutation(
        "fan/wider columns of the mirror image",
        "2 * math.tan(views.half_width_rad) / (math.sqrt(2) if shear < 0 else 1)",
        "2 * math.tan(views.half_width_rad)",
        ("test_fan",),
    ),
    Mutation(
        "body counts/strips beyond the fan",
        "reach = parts.widest_u[s] + (u1 / 2 if has_strips else 0.0)",
        "reach = parts.widest_u[s]",
        ("test_adaptive::test_the_echo_of_strips_is_what_the_nearest_samples_of_upright_rods_give_them",),
    ),
    Mutation(
        "body counts/strips of a further sector",
        "/ u1, p + uint64(s)",
        "/ u1, p",
        ("test_adaptive::test_a_body_above_the_water_asks_for_no_samples",),
    ),
    Mutation(
        "body counts/length of runs",
        "MIN_WIDTH, MAX_RUN = 6.0, 3.0",
        "MIN_WIDTH, MAX_RUN = 6.0, 30.0",
        ("test_adaptive::test_strands_are_the_runs_of_samples_on_a_body_of_many_thin_parts",),
    ),
    Mutation(
        "body counts/width of what many thin parts fill",
        "MIN_WIDTH, MAX_RUN = 6.0, 3.0",
        "MIN_WIDTH, MAX_RUN = 0.0, 3.0",
        ("test_adaptive::test_strands_are_the_runs_of_samples_on_a_body_of_many_thin_parts",),
    ),
    Mutation(
        "body counts/bodies that are not counted",
        "if bins[i] < 0.0 or not is_counted[number]:",
        "if bins[i] < 0.0:",
        ("test_adaptive::test_of_a_coarser_view_those_bodies_alone_are_counted_that_it_is_compared_by",),
    ),
    Mutation(
        "costs/finer samples",
        "MOST_FINER_COST * _usual(self.history.costs)",
        "MOST_COST * _usual(self.history.costs)",
        ("test_adaptive::TestMoving::test_samples_get_as_fine_at_once_as_a_ping_may_cost",),
    ),
    Mutation(
        "costs/check",
        "return CHECK_COST * self._cost(level) <= MOST_COST * _usual(costs)",
        "return self._cost(level) <= MOST_COST * _usual(costs)",
        ("test_adaptive::TestMoving::test_a_check_waits_until_it_costs_no_more_than_a_ping_may",),
    ),
    Mutation(
        "costs/check that waits",
        "if not (resolution.check or self._can_check(choice.level, self.history.costs)):",
        "if not resolution.check and False:",
        ("test_adaptive::TestMoving::test_a_change_of_the_echo_is_estimated_at_once_if_that_costs_no_more",),
    ),
    Mutation(
        "costs/later pings made meanwhile",
        "if n_pings >= history.n_pings:",
        "if True:",
        ("test_adaptive::TestMoving::test_the_next_pings_follow_one_whose_samples_were_chosen_alone",),
    ),
    Mutation(
        "costs/stage of a check to come",
        "if self.choice.is_due and not check:",
        "if False:",
        ("test_moving_sonar::test_pings_that_wait_for_a_check_have_made_what_it_needs",),
    ),
    Mutation(
        "sequence/pings by the caller after the first",
        "if jobs[0].is_over:",
        "if False:",
        ("test_sequence::test_the_caller_makes_no_ping_after_the_first_is_there",),
    ),
    Mutation(
        "sequence/threads beside the caller",
        'JobThreads("sonar_gl ping", n - 1)',
        'JobThreads("sonar_gl ping", n)',
        ("test_sequence::test_threads_and_the_caller_are_as_many_as_the_cores",),
    ),
    Mutation(
        "sequence/pings that no thread can choose",
        "if batch or setup.request.alone or not can_choose:",
        "if batch or not can_choose:",
        ("test_alone::test_any_order_and_company_gives_the_same_bytes",),
    ),
    Mutation(
        "stage/memory of larger views",
        "if MUCH_FEWER * most < self._room:",
        "if most < self._room:",
        ("test_adaptive::TestMoving::test_memory_is_given_back_once_many_pings_had_far_fewer_samples",),
    ),
    Mutation(
        "error/strips of both pings",
        "wrong_share(tried.echo, before.echo, coarser) + of_strips",
        "wrong_share(tried.echo, before.echo, coarser)",
        ("test_adaptive::test_the_error_of_a_body_is_judged_by_what_its_samples_show",),
    ),
    Mutation(
        "error/strips of a body",
        "np.hypot(errors, np.abs(of_strips - echo) / np.maximum(echo, 1e-30)) * counts",
        "errors * counts",
        ("test_adaptive::test_the_error_of_a_body_is_judged_by_what_its_samples_show",),
    ),
    Mutation(
        "beams/columns of a tile",
        "n_columns + -n_columns % 4",
        "n_columns + n_columns % 4",
        ("test_footprint::test_weigh_columns_is_a_circular_matrix_product",),
    ),
    Mutation(
        "beams/sums of the tile before",
        "rows[r, k] = 0.0",
        "pass",
        ("test_footprint::test_weigh_columns_is_a_circular_matrix_product",),
    ),
    Mutation(
        "noise/bandwidth of levels",
        "bandwidth_hz = acoustics.pulse_response(sonar).bandwidth_hz",
        "bandwidth_hz = sonar.bandwidth_hz",
        ("test_receiver",),
    ),
    Mutation(
        "noise/pulse shorter than a bin",
        "max(1, round(PULSE_S * sound_speed_m_s / 2 / bin_size_m))",
        "round(PULSE_S * sound_speed_m_s / 2 / bin_size_m)",
        ("test_receiver",),
    ),
    Mutation(
        "noise/loud ring-down",
        "power *= acoustics.tvg(r, sonar) return np.minimum(power, MAX_POWER)",
        "power *= acoustics.tvg(r, sonar)\n    return power",
        ("test_receiver",),
    ),
    Mutation(
        "noise/pulse in true metres",
        "sound_speed_m_s=pulse.sound_speed_m_s / scale",
        "sound_speed_m_s=pulse.sound_speed_m_s",
        ("test_place_locked_speckle",),
    ),
    Mutation(
        "batch/class of a name that is a number",
        'r"[_\\W]*\\d+$", "", name) or name',
        'r"[_\\W]*\\d+$", "", name)',
        ("batch/test_batch::test_bodies_whose_names_differ_by_a_final_number_are_one_class",),
    ),
    Mutation(
        "batch/background in capitals",
        "any(word in name.lower() for word in BACKGROUND_WORDS)",
        "any(word in name for word in BACKGROUND_WORDS)",
        ("batch/test_batch::test_shadows_fall_on_what_is_named_like_a_floor_or_a_wall",),
    ),
    Mutation(
        "batch/instances without a class",
        "(model, class_id[number]) if class_id[number] else number",
        "(model, class_id[number])",
        ("batch/test_batch::test_bodies_of_no_class_are_instances_of_their_own",),
    ),
    Mutation(
        "batch/size of a ping",
        "for array in self.arrays(sonar))",
        "for array in self.layers(sonar))",
        ("batch/test_batch::test_the_size_of_a_ping_is_that_of_its_arrays",),
    ),
    Mutation(
        "digest/surface",
        "digest.update(repr((scene.surface_z_m, scene.surface_roughness_m)).encode())",
        "",
        DIGEST,
    ),
    Mutation(
        "digest/places of plumes",
        "digest.update(repr(settings).encode() + plume.pose.tobytes())",
        "digest.update(repr(settings).encode())",
        DIGEST,
    ),
    Mutation(
        "store/classes of bodies",
        "return _take(class_id, ping.body_id)",
        "return ping.body_id.astype(class_id.dtype)",
        STORE,
    ),
    Mutation("store/range of the last bin", "range_max_m * 1.001 / 65535", "range_max_m / 65535", STORE),
    Mutation(
        "store/true ranges",
        "acoustics.true_range_sonar(sonar).range_max_m * 1.001",
        "sonar.range_max_m * 1.001",
        STORE,
    ),
    Mutation(
        "cluster/parts that wait",
        "return len(self._parts) < self._n_workers",
        "return len(self._parts) <= self._n_workers",
        ("test_cluster::test_each_worker_has_one_part_at_a_time_and_none_waits",),
    ),
    Mutation(
        "cluster/one worker of several",
        "return len(self._parts) < self._n_workers",
        "return len(self._parts) < 1",
        ("test_cluster::test_each_worker_has_one_part_at_a_time_and_none_waits",),
    ),
    Mutation(
        "cluster/workers that come back",
        "if self._n_workers: self._last_worker_s = now elif",
        "if self._n_workers:\n                pass\n            elif",
        ("test_cluster::test_workers_may_be_away_for_less_than_half_an_hour",),
    ),
    Mutation(
        "cluster/workers that are missed at the end",
        "while self._parts: self._has_free_worker() self._settle()",
        "while self._parts:\n            self._settle()",
        ("test_cluster::test_workers_that_are_away_for_longer_are_missed",),
    ),
    Mutation(
        "cluster/scheduler that has gone",
        "self._scheduler_loss_as_error(OSError, asyncio.TimeoutError)",
        "self._scheduler_loss_as_error()",
        ("test_cluster::test_a_scheduler_that_does_not_answer_has_gone",),
    ),
    Mutation(
        "cluster/count of failures",
        "{why.allowed_failures + 1}",
        "{why.allowed_failures}",
        ("test_cluster::test_a_part_that_the_scheduler_gives_up_is_reported_with_the_last_worker",),
    ),
    Mutation("cluster/part that comes twice", "if part not in finished:", "if True:", GIVEN_UP),
    Mutation("cluster/parts that were given up", "given_up.append(part)", "pass", GIVEN_UP),
    Mutation(
        "sonar files/name like a change",
        "what)) and not Path(what).exists():",
        "what)):",
        SONAR_FILES,
    ),
    Mutation(
        "sonar files/name with a hash", 'text.rpartition(".toml#")', '(text.partition(".toml#"))', SONAR_FILES
    ),
    Mutation("sonar files/defaults", "if value != field.default}", "}", SONAR_FILES),
    Mutation(
        "styles/16 bits",
        "return law.bits == 16 and self.setting_of_8_bits is None",
        "return law.bits == 16",
        STYLES,
    ),
    Mutation("styles/height in a notebook", "NOTEBOOK_HEIGHT = 500", "NOTEBOOK_HEIGHT = 400", STYLES),
    Mutation(
        "batch/corners of a hill",
        "gap = _least_gap_m(-ground, below, -corners[faces], gap)",
        "pass",
        ("test_extent::test_a_box_touches_a_hill_by_its_edge_or_by_the_peak",),
    ),
    Mutation(
        "batch/corners of a body on a floor",
        "gap = _least_gap_m(corners, faces, ground[below], gap)",
        "pass",
        ("test_extent::test_a_box_touches_a_hill_by_its_edge_or_by_the_peak",),
    ),
    Mutation("batch/depth of burial", 'draws[SHIFT_AND_TURN.index("z_m")] - gap', "-gap", RESTS),
    Mutation(
        "batch/a floor that has moved",
        "gap_m(of_bodies, floor, floor.pose if place is None else place)",
        "gap_m(of_bodies, floor, floor.pose)",
        RESTS,
    ),
    Mutation(
        "batch/places that are taken", "for b, least_m in taken.values()", "for b, least_m in []", CLEAR
    ),
    Mutation("batch/least distance", ">= max(table.clearance_m, least_m)", ">= 0", CLEAR),
    Mutation(
        "batch/a floor that moves later",
        "if later is not None:",
        "if False:",
        ("batch/test_batch::test_errors_in_a_job_name_file_table_and_key",),
    ),
    Mutation(
        "batch/signals that come at once",
        "if time.monotonic() < stopped_s + REPEAT_S:",
        "if False:",
        ("batch/test_runs::test_signals_that_come_at_once_stop_a_batch_as_one_does",),
    ),
    Mutation(
        "batch/least distance of the other",
        "max(table.clearance_m, least_m)",
        "table.clearance_m",
        ("batch/test_batch::test_bodies_keep_the_larger_distance_of_two_tables_whichever_is_first",),
    ),
    Mutation(
        "batch/axes of a shift", "move[:3, 3] += shift", "move[:3, 3] += pivot[:3, :3] @ shift", REQUESTS
    ),
    Mutation(
        "batch/times of runs",
        "delay_s = last_s + GAP_S - trajectory[0][0]",
        "delay_s = last_s + GAP_S",
        REQUESTS,
    ),
    Mutation(
        "batch/mount of a sonar",
        "mounts[name] = sonar, make_pose(*table.mount)",
        "mounts[name] = sonar, make_pose(*table.mount[:3])",
        REQUESTS,
    ),
    Mutation(
        "batch/bins of a range",
        "return sonar.with_range(table.range_m, table.bins)",
        "return sonar.with_range(table.range_m)",
        REQUESTS,
    ),
    Mutation(
        "batch/hull that the job moves",
        "vehicle is not None and not matching_names(moved, [vehicle.model, *vehicle.parts])",
        "vehicle is not None",
        ("batch/test_batch::test_a_hull_that_stays_behind_is_warned_of",),
    ),
    Mutation(
        "batch/scenes loaded for their hulls",
        "if index not in self._vehicles:",
        "if True:",
        ("batch/test_batch::test_hulls_are_known_of_scenes_that_were_loaded",),
    ),
    Mutation(
        "render/what else is named like a hull",
        "return [pattern] if set(matched) == set(parts) else parts",
        "return [pattern]",
        ("test_render::test_a_hull_that_stays_behind_is_warned_of",),
    ),
    Mutation(
        "render/hull that stays behind",
        "return model if self.parts_of(model) else None",
        "return None",
        ("test_render::test_a_hull_that_stays_behind_is_warned_of",),
    ),
    Mutation(
        "acoustics/TVG without an effect",
        "settings.get(key) is not None and acoustics.range_law",
        "key in settings and acoustics.range_law",
        ("test_acoustics::test_a_tvg_that_has_no_effect_is_warned_of",),
    ),
    Mutation(
        "batch/pings without an echo",
        "~np.any(has_echo, axis=0)",
        "~np.all(has_echo, axis=0)",
        ("batch/test_batch::test_pings_without_an_echo_are_those_that_no_sonar_sees_anything_in",),
    ),
    Mutation(
        "batch/warnings but that of no echo",
        "if issubclass(warning.category, NoEchoWarning | InsideWarning):",
        "if False:",
        ("batch/test_batch::test_a_sonar_inside_a_body_is_reported_whatever_process_makes_its_pings",),
    ),
    Mutation(
        "batch/space on the disk",
        "if isinstance(why, OSError) or is_out_of_memory(why): raise kind",
        "if is_out_of_memory(why):\n                    raise\n                kind",
        ("batch/test_batch::test_what_the_machine_lacks_sets_no_ping_aside",),
    ),
    Mutation(
        "empty pings/range that the sonar shows",
        "return true_range_m * sonar.range_max_m / true_range.range_max_m",
        "return true_range_m",
        EMPTY_PINGS,
    ),
    Mutation(
        "empty pings/depth of the sonar",
        "up * (surface_z_m - SURFACE_MARGIN_M - pose[2, 3])",
        "up * (surface_z_m - SURFACE_MARGIN_M)",
        EMPTY_PINGS,
    ),
    Mutation(
        "planner/error by the number of samples",
        "BODY_ERROR_FACTOR, BODY_ERROR_RATE = 1.8, 0.75",
        "BODY_ERROR_FACTOR, BODY_ERROR_RATE = 0.9, 0.75",
        ("test_adaptive",),
    ),
    Mutation(
        "planner/greatest gain in a span",
        "int(min(max(last, 0), n - 1)) + 1)",
        "int(min(max(last, 0), n - 1)))",
        ("test_adaptive",),
    ),
    Mutation(
        "reflectivity/mean over a face",
        "SPLITS_OF_MEAN = 4",
        "SPLITS_OF_MEAN = 1",
        ("test_reflectivity_map",),
    ),
    Mutation(
        "live/sector of a scan",
        "sector = self.start, self.stop, self.step, round(1e3 * self.delay_s)",
        "sector = self.stop, self.start, self.step, round(1e3 * self.delay_s)",
        ("test_ping360",),
    ),
    Mutation(
        "live/range of a sample",
        "settings.n_samples * settings.sample_time_s * speed_m_s / 2",
        "settings.n_samples * settings.sample_time_s * speed_m_s",
        ("test_ping360",),
    ),
    Mutation(
        "live/speed of sound that a program sets",
        "acoustics = replace(acoustics, sonar_sound_speed_m_s=fire.sound_speed_m_s)",
        "pass",
        ("test_oculus",),
    ),
    Mutation("live/rate after a pause", "pinged_s[0] < from_s or", "", ("test_session",)),
    Mutation(
        "live/gains of an Oculus",
        "self.gain / self.gain.max() * GREATEST_GAIN",
        "self.gain",
        ("test_oculus",),
    ),
    Mutation(
        "live/pings that waited to be written",
        "if problem := _problem(listener):",
        'if problem := "":',
        ("test_output",),
    ),
    Mutation(
        "compiled/other files of a package",
        "if os.path.basename(folder) == TOGETHER and os.path.isdir(folder):",
        "if False:",
        ("test_compiled",),
    ),
    Mutation(
        "compiled/archives",
        "return _state_of(folder) if folder != path else None",
        "return None",
        ("test_compiled",),
    ),
    Mutation(
        "warn/other categories",
        "collection is not None and issubclass(category, collection.category)",
        "collection is not None",
        WARN,
    ),
    Mutation(
        "warn/innermost block",
        "(ref(collection), *around)",
        "(*around, ref(collection))",
        WARN,
    ),
    Mutation("warn/end of a block", "finally: _collections.set(around)", "finally: collection", WARN),
    Mutation(
        "warn/shown besides",
        "append(CollectedWarning(text, category))\n            return",
        "append(CollectedWarning(text, category))",
        WARN,
    ),
    Mutation("warn/control characters", "text = escape_controls(message)", "text = message", WARN),
    Mutation(
        "footprints/horizon of a trapezoid",
        "if s < wide + thin: scale = energy * s / (energy_below(s + wide + thin, s, wide, thin) "
        "- energy_below(0.0, s, wide, thin)) row",
        "if s < wide - thin:\n        scale = energy * s / (energy_below(s + wide + thin, s, wide, thin) "
        "- energy_below(0.0, s, wide, thin))\n    row",
        ("test_footprint",),
    ),
    # shapes, scenes and their levels of detail
    Mutation(
        "shapes/normals of a cone",
        "(across, up) = facets_around(radius), (length / side, radius / side)",
        "(across, up) = facets_around(radius), (radius / side, length / side)",
        ("test_primitives",),
    ),
    Mutation(
        "shapes/edges of four faces",
        "len(forward) == 0 or (np.diff(forward) == 0).any() or not",
        "len(forward) == 0 or not",
        ("test_primitives",),
    ),
    Mutation(
        "shapes/arrays of a trimesh",
        "self.vertices.copy(), self.faces.copy()",
        "self.vertices, self.faces",
        ("test_primitives",),
    ),
    Mutation(
        "scene/long and high",
        "size_m.max() < LONG_M or size_m.min() < HIGH_M",
        "size_m.max() < LONG_M and size_m.min() < HIGH_M",
        ("test_extent",),
    ),
    Mutation(
        "scene/mirrored body",
        "atol=RIGID) and np.linalg.det(linear) > 0",
        "atol=RIGID)",
        ("test_load::test_a_trimesh_scene_keeps_coordinates_and_applies_scale_to_vertices",),
    ),
    Mutation(
        "scene/lobe of the material before",
        'self._set("specular", None) self._set("roughness_rad", None)',
        "pass",
        ("test_materials",),
    ),
    Mutation(
        "sdf/invisible solid",
        'if element.tag != "visual" or link.element.find("collision") is not None:',
        'if element.tag != "visual":',
        SDF,
    ),
    Mutation(
        "mujoco/turn of a mocap body",
        "what.qpos, what.mocap_pos, what.mocap_quat",
        "what.qpos, what.mocap_pos, data.mocap_quat",
        ("test_mujoco_model",),
    ),
    Mutation(
        "levels/equal vertices merged",
        "if (ordered[1:] == ordered[:-1]).any():",
        "if False:",
        ("test_level_of_detail",),
    ),
    Mutation(
        "levels/mesh inside out",
        "if closed < 0: faces = faces[:, ::-1]",
        "if closed < 0:\n        pass",
        ("test_level_of_detail",),
    ),
    Mutation(
        "levels/far from the origin",
        "simplify(points[used] - points[used[0]], patch",
        "simplify(points[used], patch",
        ("test_level_of_detail",),
    ),
    # noise that belongs to a place, and pictures
    Mutation(
        "noise/texture of the speckle's pattern",
        "seed, 0, term, *((n",
        'seed, 0, "speckle", *((n',
        ("test_k_distribution",),
    ),
    Mutation("noise/order of cells by use", "cells.pop(key, None) if", "if", ("test_place_locked_speckle",)),
    Mutation(
        "noise/reach of coarse weights",
        "margin = max(margin, furthest)",
        "pass",
        ("test_place_locked_speckle",),
    ),
    Mutation(
        "fan image/beams after the mean",
        "known_beam) + 0.5) * (n_beams / shape[0]) - 0.5",
        "known_beam)) * (n_beams / shape[0])",
        FAN,
    ),
    Mutation(
        "demarco/nearest range",
        "(range_m >= sonar.range_min_m) & (range_m < sonar.range_max_m)",
        "range_m < sonar.range_max_m",
        ("test_demarco2015",),
    ),
    Mutation(
        "demarco/jump of a quad",
        "MAX_JUMP * range_m.min(axis=1)",
        "MAX_JUMP * range_m.max(axis=1)",
        ("test_demarco2015",),
    ),
    # what others send and receive
    Mutation(
        "embed/axes of the head",
        "sonar.sonar_from_head[:3, :3].T @ self.rotation",
        "sonar.sonar_from_head[:3, :3] @ self.rotation",
        ("test_camera",),
    ),
    Mutation(
        "embed/cameras by use",
        "self._rigs.pop(key, None)) is None",
        "self._rigs.get(key)) is None",
        ("test_depth_images",),
    ),
    Mutation(
        "embed/speckle without a place",
        "noise = replace(noise, follow_motion=False)",
        "pass",
        ("test_depth_images",),
    ),
    Mutation(
        "ros/beams of a tilted head",
        "turn = ping.sonar.sonar_from_head[:3, :3] @ turn",
        "turn = turn @ ping.sonar.sonar_from_head[:3, :3]",
        ("test_bag",),
    ),
    Mutation(
        "ros/vehicle of the scene's sonar",
        "scene.sonar_pose @ np.linalg.inv(self.settings.vehicle_from_sonar)",
        "scene.sonar_pose @ self.settings.vehicle_from_sonar",
        ("test_publisher",),
    ),
    Mutation("ros/time of a ping", "time_s=time_ns / 1e9", "time_s=time_ns / 1e6", ("test_publisher",)),
    Mutation(
        "batch/redrawn places of each ping",
        "self._random(CLEARANCE_STREAM, number, k, n)",
        "self._random(CLEARANCE_STREAM, k, n)",
        CLEAR,
    ),
    Mutation(
        "batch/redrawn places of each body",
        "self._random(CLEARANCE_STREAM, number, k, n)",
        "self._random(CLEARANCE_STREAM, number, k)",
        CLEAR,
    ),
    Mutation(
        "batch/draws after a place",
        "more = self._random(CLEARANCE_STREAM, number, k, n)",
        "more = random",
        CLEAR,
    ),
    Mutation(
        "batch/places that were left",
        "for found in (bodies, reflectivity, taken):",
        "for found in (bodies, reflectivity):",
        ABSENT,
    ),
    Mutation(
        "batch/reflectivity without a place",
        "if mu is not None and is_present:",
        "if mu is not None:",
        ABSENT,
    ),
    Mutation(
        "batch/beside a floor",
        "if math.isfinite(gap):  # else beside the floor: as drawn",
        "if True:",
        BESIDE_FLOOR,
    ),
    Mutation(
        "batch/plumes that rest",
        "for name, pose in poses.items() if isinstance(known[name], Body)]",
        "for name, pose in poses.items()]",
        BESIDE_FLOOR,
    ),
    Mutation(
        "batch/sonar in a body that moves",
        "poses = [request.bodies.get(body.name, body.pose) for body in bodies]",
        "poses = [body.pose for body in bodies]",
        FIRST_PLACE,
    ),
    Mutation(
        "batch/sonar in an absent body",
        "np.array([pose is not None for pose in poses], bool)",
        "np.array([True for pose in poses], bool)",
        FIRST_PLACE,
    ),
    Mutation(
        "batch/place of a mounted sonar",
        "present, (request.vehicle_pose @ mount)[:3, 3])",
        "present, request.vehicle_pose[:3, 3])",
        FIRST_PLACE,
    ),
    Mutation("batch/upright faces of a floor", "meets = (whole != 0) & (", "meets = (", EXTENT),
    Mutation("batch/vertices of no face", "vertices[np.unique(faces)]", "vertices", EXTENT),
    Mutation("batch/floor of many faces", "max(1, PAIRS // len(lower))", "PAIRS // len(lower)", EXTENT),
    Mutation(
        "render/heights beyond the range", "np.hypot(np.hypot(x, y), z).min()", "np.hypot(x, y).min()", EXTENT
    ),
    Mutation(
        "store/classes of 16 bits",
        "np.uint8 if len(self.classes) < 256 else",
        "np.uint8 if len(self.classes) <= 256 else",
        ("batch/test_batch::test_the_numbers_of_classes_fit",),
    ),
    Mutation(
        "store/classes of a later scene",
        "self.class_id[1 + first :]",
        "self.class_id[1:]",
        ("batch/test_batch::test_bodies_of_several_scenes_have_numbers_of_their_own",),
    ),
    Mutation(
        "cli/signal of the caller",
        "if signal.getsignal(signal.SIGINT) is signal.default_int_handler:",
        "if True:",
        SIGNALS,
    ),
    Mutation(
        "cli/ignored hang-up",
        'hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL',
        'hasattr(signal, "SIGHUP")',
        SIGNALS,
    ),
    Mutation("cli/signal after the end", "again.cancel()", "pass", SIGNALS),
    Mutation(
        "multipath/whole error of many samples",
        "if self.images.halvings >= 0 else 1.0",
        "if self.images.halvings > 0 else 1.0",
        IMAGE_SAMPLING,
    ),
    Mutation("multipath/steps of many samples", "step = 1 if own > 0 else 2", "step = 1", IMAGE_SAMPLING),
    Mutation(
        "multipath/step past what fits",
        "wanted = max(own - step, _finest_for(echo.images))",
        "wanted = own - step",
        IMAGE_SAMPLING,
    ),
    Mutation(
        "sequence/reasons by overwritten samples",
        "if not run.is_to_explain(received):",
        "if True:",
        ("engine/test_sequence::test_pings_without_an_echo_are_explained_as_in_single_calls",),
    ),
    Mutation("multipath/more without a comparison", "wanted = max(wanted, 0)", "pass", IMAGE_SAMPLING),
    Mutation(
        "multipath/error of a body that images see",
        "of_imaged <= WORST_BODY * allowed",
        "of_imaged <= allowed",
        IMAGE_SAMPLING,
    ),
    Mutation(
        "multipath/samples of a body that images see",
        "max(of_direct, of_imaged) <= allowed",
        "of_direct <= allowed",
        IMAGE_SAMPLING,
    ),
    Mutation("labels/room that just suffices", "all(n <= of_room", "all(n < of_room", ROOM),
    Mutation("labels/room that shrinks", "max(room.n_runs, 2 * needed.n_runs)", "2 * needed.n_runs", ROOM),
    Mutation(
        "labels/last number of the room",
        "n_pool + MOMENTS * length <= pool.shape[0]",
        "n_pool + MOMENTS * length < pool.shape[0]",
        AGAIN,
    ),
    Mutation(
        "labels/last run of the room",
        "fits = n_runs < runs.shape[0] and",
        "fits = n_runs + 1 < runs.shape[0] and",
        AGAIN,
    ),
    Mutation("labels/slots one by one", "most_slots, slot = 2 * slot, slot - 1", "slot = slot - 1", AGAIN),
    Mutation(
        "triangles/lobes of the row before",
        "if with_lobes:\n            lobes[:] = 0.0",
        "if False:\n            lobes[:] = 0.0",
        ("test_engines::test_views_of_lobes_alone_are_shaded_with_the_whole_view",),
    ),
    Mutation("store/last body of 16 bits", "n_bodies < 65536 else", "n_bodies <= 65536 else", STORE),
    Mutation("store/steepest incidence", "math.pi / 2 / 254, 255", "math.pi / 2 / 255, 255", STORE),
)


@cache
def tokens_of(text: str) -> tuple[list[str], list[tuple[int, int]]]:
    """Return the tokens of a text without its comments, and the span of each."""
    found = []
    start = 0
    for line in text.splitlines(keepends=True):
        code = re.sub(r"(?:^|\s)#\s.*", lambda match: " " * len(match[0]), line.rstrip("\n"))
        found += [(match[0], (start + match.start(), start + match.end())) for match in TOKEN.finditer(code)]
        start += len(line)
    return [token for token, _ in found], [span for _, span in found]


def places_of(old: str, root: Path) -> list[tuple[Path, int, int]]:
    """Return where a text stands in the package: file, first character and past the last."""
    wanted, out = tokens_of(old)[0], []
    for path in sorted((root / "sonar_gl").rglob("*.py")):
        tokens, spans = tokens_of(path.read_text(encoding="utf-8"))
        if " ".join(wanted) not in " ".join(tokens):  # most files, and much faster than the loop
            continue
        for k in range(len(tokens) - len(wanted) + 1):
            if tokens[k] == wanted[0] and tokens[k : k + len(wanted)] == wanted:
                out.append((path, spans[k][0], spans[k + len(wanted) - 1][1]))
    return out


def test_files(mutation: Mutation) -> list[str]:
    """Return the test files of a mutation, or tests of them, as arguments of pytest, relative to the root."""
    out = []
    for words in mutation.tests:
        name, *test = words.split("::")
        found = sorted((ROOT / "tests").rglob(f"{name}.py"))
        if len(found) != 1:
            raise SystemExit(
                f"{mutation.name}: there must be one module {name} in tests/ (there are {len(found)})"
            )
        text = found[0].read_text(encoding="utf-8")
        if not all(re.search(rf"(def|class) {part.partition('[')[0]}\b", text) for part in test):
            raise SystemExit(f"{mutation.name}: there is no {'::'.join(test)} in {found[0]}")
        out.append("::".join((found[0].relative_to(ROOT).as_posix(), *test)))
    return list(dict.fromkeys(out))


def edits_of(mutation: Mutation, root: Path) -> list[tuple[Path, int, int, str]]:
    """Return where a mutation applies, and its new text; there should be one such place."""
    return [(*place, mutation.new) for place in places_of(mutation.old, root)]


def mutated(path: Path, first: int, past: int, new: str) -> str:
    """Return the text of a file with the mistake."""
    text = path.read_text(encoding="utf-8")
    return text[:first] + new + text[past:]


def apply(mutation: Mutation, root: Path):
    """Put the mistake into a tree."""
    ((path, *edit),) = edits_of(mutation, root)
    path.write_text(mutated(path, *edit), encoding="utf-8")


def run_pytest(root: Path, words: list[str]) -> tuple[int | None, str]:
    """Run pytest in a tree; return its exit status, None after the timeout, and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-m", "pytest", "-x", "-rfE", "-p", "no:cacheprovider", *words]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, done.stdout + done.stderr


def copied(folder: str) -> Path:
    """Copy the tree, with its compiled kernels."""
    out = Path(folder) / "tree"
    shutil.copytree(ROOT, out, ignore=shutil.ignore_patterns(*UNCOPIED), symlinks=True)
    return out


def judge(mutation: Mutation, words: list[str]) -> tuple[bool, str]:
    """Return whether tests notice a mutation, and which."""
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(folder)
        apply(mutation, tree)
        status, printed = run_pytest(tree, words)
    if status == PASSED:
        return False, ""
    if status is None:
        return True, f"longer than {TIMEOUT_S:g} s"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", printed, re.MULTILINE)
    return True, failed[1] if failed else f"pytest ended with {status}"


def check_baseline(words: list[str]):
    """End the program unless tests pass without a mutation."""
    with tempfile.TemporaryDirectory() as folder:
        status, printed = run_pytest(copied(folder), words)
    if status != PASSED:
        raise SystemExit(f"{shlex.join(words)} must pass without a mutation:\n{printed[-3000:]}")


def print_list(mutations) -> bool:
    """Print where each mutation applies; return whether all do.

    End the program where one has no tests, or is no Python: any test would notice that.
    """
    good = True
    for mutation in mutations:
        test_files(mutation)
        edits = edits_of(mutation, ROOT)
        for edit in edits:
            try:
                ast.parse(mutated(*edit))
            except SyntaxError as why:
                raise SystemExit(f"{mutation.name}: {why}") from None
        good &= len(edits) == 1
        where = ", ".join(path.relative_to(ROOT).as_posix() for path, *_ in edits)
        print(f"{mutation.name:42} {where if len(edits) == 1 else f'{len(edits)} places: {where}'}")
    return good


def main():
    """List or run mutations."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutations", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--list", action="store_true", help="print the table; exit status 1 if one does not apply"
    )
    parser.add_argument("--run", action="store_true", help="run them")
    parser.add_argument("--only", default="*", metavar="GLOB", help="mutations by name, such as 'labels/*'")
    options = parser.parse_args()
    mutations = [one for one in MUTATIONS if fnmatchcase(one.name, options.only)]
    if not mutations:
        parser.error(f"no mutation is named like {options.only!r}")
    if not options.run:
        raise SystemExit(0 if print_list(mutations) else 1)
    good, killed, passing = print_list(mutations), 0, set()
    if not good:
        raise SystemExit("each mutation must occur once")
    for mutation in mutations:
        words = test_files(mutation)
        if tuple(words) not in passing:
            check_baseline(words)
            passing.add(tuple(words))
        start = perf_counter()
        is_killed, by = judge(mutation, words)
        killed += is_killed
        verdict = f"killed by {by}" if is_killed else "survived"
        print(f"{mutation.name:42} {perf_counter() - start:5.0f} s  {verdict}", flush=True)
    print(f"killed {killed} of {len(mutations)}, {killed / len(mutations):.0%}")
    raise SystemExit(0 if killed == len(mutations) else 1)


if __name__ == "__main__":
    main()

"""The arrays of samples that the beamformer sums."""

import numpy as np
import pytest

from sonar_gl.sonar.samples import BESIDE_ECHO, SectorSamples, whole_rows
from sonar_gl.sonar.sector import SHEAR, make_sector


@pytest.mark.parametrize("tail", [(), (4,)])
def test_whole_rows_are_a_contiguous_view_that_begins_where_the_window_does(tail):
    image = np.arange(5 * 7 * int(np.prod(tail)), dtype=np.float32).reshape(5, 7, *tail)
    window = image[:4, 2:5]
    rows = whole_rows(window)
    assert rows.flags.c_contiguous and rows.shape == (4, 7, *tail) and np.shares_memory(rows, image)
    np.testing.assert_array_equal(rows[:, :3], window)


def test_an_array_of_its_own_is_returned_as_it_is():
    image = np.zeros((5, 7, 4), np.float32)
    assert whole_rows(image) is image and whole_rows(image[:0]).size == 0


def sector_samples(echo) -> SectorSamples:
    """Return samples with this echo, (R, C), in a window of an image of other samples."""
    rows, columns = echo.shape
    sector = make_sector(0.2, 0.3, 12, 10, (-0.2, 0.2), SHEAR).within(1, 2, columns, rows)
    image = np.ones((rows, columns + 9, 4), np.float32)
    faces = np.arange(image[..., 0].size, dtype=np.int32).reshape(rows, -1)
    here = (slice(0, rows), slice(4, 4 + columns))
    image[here][..., 3] = echo
    return SectorSamples(sector, image[here], np.empty((0, 0), np.uint16), faces[here])


@pytest.mark.parametrize(
    "places", [[(5, 6)], [(5, 6), (8, 4)], [(0, 0)], [(11, 9)], [(3, 9), (4, 0)], [(0, 9), (11, 0)]]
)
def test_the_window_with_echo_holds_all_of_it_and_its_neighbours_alone(places):
    echo = np.zeros((12, 10), np.float32)
    for place in places:
        echo[place] = 1e-30
    samples = sector_samples(echo)
    part = samples.with_echo()
    rows, columns = np.transpose(places)
    bottom, low = max(rows.min() - BESIDE_ECHO, 0), max(columns.min() - BESIDE_ECHO, 0)
    here = slice(bottom, rows.max() + 1 + BESIDE_ECHO), slice(low, columns.max() + 1 + BESIDE_ECHO)
    np.testing.assert_array_equal(part.plane_echo, samples.plane_echo[here])
    np.testing.assert_array_equal(part.face_id, samples.face_id[here])
    assert part.plane_echo.shape[:2] == (part.sector.rows, part.sector.columns) and not part.body_id.size
    for mine, whole in zip(
        part.sector.sample_coordinates(), samples.sector.sample_coordinates(), strict=True
    ):
        np.testing.assert_allclose(mine, whole[here], rtol=0, atol=1e-15)  # rounding of float64


def test_samples_without_echo_have_an_empty_window():
    part = sector_samples(np.zeros((12, 10), np.float32)).with_echo()
    assert part.plane_echo.size == part.sector.rows == part.sector.columns == 0
    assert part.with_echo() is part

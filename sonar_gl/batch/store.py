"""The arrays of a batch: a Zarr group that xarray opens as a data set, written part by part."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec

from sonar_gl.batch.files import Folder

NAME = "pings.zarr"
CHUNK = 8  # pings that are packed together; whole parts are files
# LZ4 takes half of Zstandard's time and gives a tenth away. Of floats, bits of one weight lie side by side:
# what is rounded away packs to nothing. Labels come in runs of one number, which whole bytes keep.
FLOATS, LABELS = (BloscCodec(cname="lz4", clevel=5, shuffle=how) for how in ("bitshuffle", "shuffle"))
TABLE_CHUNK = 16384  # pings, of what has one number a ping


def _group(folder: Folder, mode: str):
    # what was gathered would go on with what is made anew, and into groups' own files
    return zarr.open_group(f"{folder.url}/{NAME}", mode=mode, use_consolidated=False)


def create(folder: Folder, n_pings: int, part: int, sonars: dict, attributes: dict) -> None:
    """Make the arrays, empty; those that are there stay as they are, for others may write into them.

    Parameters
    ----------
    part : pings of a part, each of which is one file of each array
    sonars : by name, (Sonar, layers, per-body layers (name, dtype, shape of a ping, dims, fill, attributes),
        attributes)
    attributes : of the data set
    """
    _sweep(folder)
    root = _group(folder, "a")
    root.attrs.update(attributes)
    for name, (sonar, layers, per_body, about_sonar) in sonars.items():
        group = root if len(sonars) == 1 else root.require_group(name)
        group.attrs.update({**attributes, **about_sonar})
        shape = sonar.n_beams, sonar.n_bins
        chunk = np.gcd(CHUNK, part)
        about = [
            (layer.name, layer.dtype, shape, ("beam", "range"), layer.fill, layer.attributes)
            for layer in layers
        ]
        for layer, dtype, size, dims, fill, attrs in [*about, *per_body]:
            if layer in group:
                continue
            group.create_array(
                layer,
                shape=(n_pings, *size),
                dtype=dtype,
                chunks=(int(chunk), *size),
                shards=(part, *size),
                compressors=FLOATS if np.dtype(dtype).kind == "f" else LABELS,
                fill_value=fill,
                dimension_names=("ping", *dims),
                attributes={**attrs, **({"coordinates": "azimuth_rad"} if "beam" in dims else {})},
            )
        axis(group, "azimuth_rad", ("beam",), sonar.azimuth_rad, "beam centres, positive to port", "rad")
        axis(group, "range", ("range",), sonar.range_m, "slant range, bin centres", "m")


def axis(group, name, dims, values, long_name, units) -> None:
    """Put a small array there."""
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=values.shape,
        dimension_names=dims,
        attributes={"long_name": long_name, "units": units},
        overwrite=True,
    )
    array[:] = values


class Writer:
    """Writes into a store that is there."""

    def __init__(self, folder: Folder, n_sonars: int):
        self._root, self._n_sonars, self._folder = _group(folder, "r+"), n_sonars, folder

    def group(self, sonar: str):
        """The arrays of a sonar."""
        return self._root if self._n_sonars == 1 else self._root[sonar]

    def write(self, sonar: str, first: int, arrays: dict) -> list[str]:
        """Put the arrays of consecutive pings in their place, whole shards of them.

        Returns
        -------
        names of the files, in the folder
        """
        group, names = self.group(sonar), []
        for name, values in arrays.items():
            place = [first // group[name].shards[0], *[0] * (values.ndim - 1)]
            names.append("/".join([NAME, group[name].path, "c", *map(str, place)]))
            self._folder.forget(names[-1])  # what is there may be damaged, and would be read
            array = group[name].with_config({"write_empty_chunks": True})  # to look for these takes as long
            array[first : first + len(values)] = values
            if self._folder.is_local:  # what a process that was killed has left
                for torn in Path(self._folder.path(names[-1])).parent.glob("*.partial"):
                    torn.unlink(missing_ok=True)
        return names

    def add(self, sonar: str, name: str, dtype: str, dims, shape, attributes) -> None:
        """Make an array with a few numbers a ping, or make it anew."""
        self.group(sonar).create_array(
            name,
            shape=shape,
            dtype=dtype,
            chunks=(min(shape[0], TABLE_CHUNK), *shape[1:]),
            fill_value=np.nan if dtype == "float64" else 0,
            dimension_names=("ping", *dims),
            attributes=attributes,
            overwrite=True,
        )


def _sweep(folder: Folder) -> None:
    """Take away what a process that was killed has left of groups' and arrays' own files."""
    if folder.is_local:
        for depth in ("*", "*/*", "*/*/*"):
            for torn in Path(folder.path(NAME)).glob(f"{depth}.partial"):
                torn.unlink(missing_ok=True)


def consolidate(folder: Folder) -> None:
    """Gather the metadata of all arrays into one file, which is what readers look into first."""
    _sweep(folder)
    with warnings.catch_warnings():  # that version 3 of the format does not say how: all readers do it so
        warnings.simplefilter("ignore", UserWarning)
        zarr.consolidate_metadata(_group(folder, "r+").store)
    place = f"{NAME}/zarr.json"
    folder.put_json(place, folder.get_json(place))  # sorted: folders are listed in any order


def files(folder: Folder, of_parts: set) -> list[str]:
    """Names of all files but those of arrays that parts write."""
    out = []
    root = _group(folder, "r")
    for group in (root, *(group for _, group in root.groups())):
        place = "/".join(filter(None, (NAME, group.path)))
        out.append(f"{place}/zarr.json")
        for name in group.array_keys():
            inner = folder.fs.find(folder.path(f"{place}/{name}"))
            inner = [path[len(folder.root) + 1 :] for path in inner]
            out += [path for path in inner if name not in of_parts or path.endswith("zarr.json")]
    return out

"""The store of a batch: a Zarr group that xarray opens as a data set.

Parts write bins and bodies straight into it; numbers per ping come from the `ping_table` at the end of the batch.
"""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec
from zarr.storage import MemoryStore

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.manifest import CHUNK_PINGS, Manifest
from sonar_gl.batch.schema import ArraySpec
from sonar_gl.core.errors import Error
from sonar_gl.sonar.sonar import Sonar

STORE_NAME = "pings.zarr"
# LZ4 takes half the time of Zstandard, for files a tenth larger. Shuffled by bits, the mantissa bits that are
# rounded away pack to nothing. Labels come in runs of one number, which shuffling by bytes keeps.
FLOATS, LABELS = (BloscCodec(cname="lz4", clevel=5, shuffle=how) for how in ("bitshuffle", "shuffle"))
TABLE_CHUNK_PINGS = 16384  # of arrays with one number per ping


def check_groups(n_sonars: int) -> None:
    """Raise an Error if Zarr cannot open a group within another: it does a step of that in an `assert`."""
    if n_sonars > 1 and sys.flags.optimize:
        raise Error(
            "a batch of several sonars must run with Python's assertions, without which Zarr opens no group of a "
            f"sonar (got python -{'O' * sys.flags.optimize}; leave that out, or unset PYTHONOPTIMIZE)"
        )


@dataclass(frozen=True)
class SonarGroup:
    """A sonar's group in the store: its sonar, the arrays that parts write, and the group's attributes."""

    sonar: Sonar
    arrays: list[ArraySpec]
    attributes: dict


def create_arrays(
    folder: Folder, manifest: Manifest, groups: dict[str, SonarGroup], attributes: dict
) -> None:
    """Create the empty arrays of a store. Files that are there as they should be stay, and so do all pings.

    groups : groups by name of the sonar; a single sonar has no group of its own
    attributes : of the data set
    """
    _remove_partial_files(folder)
    files, part = {}, manifest.pings_per_part
    of_root = {"sonars": list(groups)} if len(groups) > 1 else {}  # a root without arrays says where they are
    root = zarr.create_group(MemoryStore(files), attributes={**attributes, **of_root})
    for name, entry in groups.items():
        group = root if len(groups) == 1 else root.require_group(name)
        group.attrs.update({**attributes, **entry.attributes})
        for array in entry.arrays:
            coordinates = {"coordinates": "azimuth_rad"} if "beam" in array.dims else {}
            group.create_array(
                array.name,
                shape=(manifest.n_pings, *array.shape),
                dtype=array.dtype,
                chunks=(int(np.gcd(CHUNK_PINGS, part)), *array.shape),
                shards=(part, *array.shape),
                compressors=FLOATS if np.dtype(array.dtype).kind == "f" else LABELS,
                fill_value=array.fill,
                dimension_names=("ping", *array.dims),
                attributes={**array.attributes, **coordinates},
            )
        azimuth = {"long_name": "beam centres, positive to port", "units": "rad"}
        _create_axis(group, "azimuth_rad", "beam", entry.sonar.azimuth_rad, azimuth)
        bins = {"long_name": "slant range, bin centres", "units": "m"}
        _create_axis(group, "range", "range", entry.sonar.range_m, bins)
    for key, data in sorted(files.items()):
        name, data = f"{STORE_NAME}/{key}", data.to_bytes()
        if folder.get(name) != data:  # a power failure may have left half of it
            folder.put(name, data)


def _open_group(folder: Folder, mode: str) -> zarr.Group:
    # consolidated metadata would hide arrays that are created later, and be written into groups' own files
    return zarr.open_group(f"{folder.url}/{STORE_NAME}", mode=mode, use_consolidated=False)


def _create_axis(group: zarr.Group, name: str, dim: str, values: np.ndarray, attributes: dict) -> None:
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=values.shape,
        dimension_names=(dim,),
        attributes=attributes,
    )
    array[:] = values


def _remove_partial_files(folder: Folder) -> None:
    """Delete what killed processes left of the metadata files of groups and arrays."""
    if folder.is_local:
        for depth in ("*", "*/*", "*/*/*"):
            for path in Path(folder.path(STORE_NAME)).glob(f"{depth}.partial"):
                path.unlink(missing_ok=True)


class PingStore:
    """A store that exists, open for reading and writing."""

    def __init__(self, folder: Folder, n_sonars: int):
        self._root, self._n_sonars, self._folder = _open_group(folder, "r+"), n_sonars, folder

    def group(self, sonar: str) -> zarr.Group:
        """Return the group with the arrays of a sonar."""
        return self._root if self._n_sonars == 1 else self._root[sonar]

    def write(self, sonar: str, first: int, arrays: dict[str, np.ndarray]) -> list[str]:
        """Write the arrays of a part, which are whole shards of the store; return the names of the files.

        first : number of the part's first ping
        arrays : by name, (pings of the part, ...)
        """
        group, names = self.group(sonar), []
        for name, values in arrays.items():
            array = group[name]
            shard = [first // array.shards[0], *[0] * (values.ndim - 1)]
            key = "/".join(["c", *map(str, shard)])
            names.append(f"{STORE_NAME}/{array.path}/{key}")
            self._folder.put(names[-1], _encode_shard(array, first, values, key))
        return names

    def create_variable(self, sonar: str, array: ArraySpec, n_pings: int) -> None:
        """Create an array with a few numbers for each ping; an existing one is replaced."""
        self.group(sonar).create_array(
            array.name,
            shape=(n_pings, *array.shape),
            dtype=array.dtype,
            chunks=(min(n_pings, TABLE_CHUNK_PINGS), *array.shape),
            fill_value=array.fill,
            dimension_names=("ping", *array.dims),
            attributes=array.attributes,
            overwrite=True,
        )


def _encode_shard(array: zarr.Array, first: int, values: np.ndarray, key: str) -> bytes:
    """Return the bytes of a shard, which holds the pings from `first` on and no others.

    They are encoded in memory and not in the store, where a shard that is there would be read, which may be
    damaged. Empty chunks are written, since finding them takes as long.
    """
    files, how = {}, {"fill_value": array.fill_value, "config": {"write_empty_chunks": True}}
    alone = zarr.from_array(MemoryStore(files), data=array, write_data=False, **how)
    alone[first : first + len(values)] = values
    return files[key].to_bytes()


def consolidate(folder: Folder) -> None:
    """Gather the metadata of all arrays into one file, which readers open first."""
    _remove_partial_files(folder)
    with warnings.catch_warnings():  # version 3 of the format does not specify it, but all readers know it
        warnings.simplefilter("ignore", UserWarning)
        zarr.consolidate_metadata(_open_group(folder, "r+").store)
    name = f"{STORE_NAME}/zarr.json"
    folder.put_json(name, json.loads(folder.get(name)))  # sorted, since folders are listed in any order


def shared_files(folder: Folder, part_arrays: set[str]) -> list[str]:
    """Return the names of the store's files that belong to no part."""
    out, root = [], _open_group(folder, "r")
    for group in (root, *(group for _, group in root.groups())):
        place = "/".join(filter(None, (STORE_NAME, group.path)))
        out.append(f"{place}/zarr.json")
        for name in group.array_keys():
            if name in part_arrays:  # which may have a million shards
                out.append(f"{place}/{name}/zarr.json")
                continue
            inner = folder.fs.find(folder.path(f"{place}/{name}"))
            out += [path[len(folder.root) + 1 :] for path in inner]
    return out

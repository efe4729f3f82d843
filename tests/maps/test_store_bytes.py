"""Chunks and metadata of a store are byte-identical to the files that zarr writes."""

import tempfile
import warnings
from pathlib import Path

import numpy as np
import xarray as xr
import zarr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vijax.maps.storage.store import array_metadata, compressors, encode_chunk, metadata_files, void_value, write_files

KINDS = st.sampled_from(["<f8", "<f4", "<i4", "|i1", "|b1"])
SHAPES = arrays.array_shapes(min_dims=0, max_dims=3, max_side=9)


@given(chunk=arrays.arrays(KINDS, SHAPES), turned=st.booleans())
def test_encoded_chunk_is_byte_identical_to_zarr(chunk, turned):
    chunk = chunk.T if turned else chunk
    with tempfile.TemporaryDirectory() as folder:
        array = zarr.create_array(folder, data=chunk, chunks=chunk.shape, compressors=compressors(), fill_value=None)
        array.with_config({"write_empty_chunks": True})[...] = chunk
        (written,) = (path for path in Path(folder).rglob("*") if path.is_file() and path.name != "zarr.json")
        assert encode_chunk(chunk) == written.read_bytes()


@given(kinds=st.lists(KINDS, max_size=3), shape=SHAPES, parts=st.integers(1, 3))
def test_metadata_are_byte_identical_to_zarr(kinds, shape, parts):
    dims, chunks = [f"x{index}" for index in range(len(shape))], tuple(-(-side // parts) for side in shape)
    attributes = {"title": "a map", "harvester_r": 0.5}
    variables = {
        f"v{index}": xr.Variable(dims, np.zeros(shape, kind), {"units": "1"}) for index, kind in enumerate(kinds)
    }
    voids = {name: void_value(name, variable.dtype) for name, variable in variables.items()}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # consolidated metadata are not part of the format yet
        ours, theirs = Path(folder, "ours"), Path(folder, "theirs")
        layouts = {name: array_metadata(entry, shape, chunks, voids[name]) for name, entry in variables.items()}
        write_files(ours, metadata_files(attributes, layouts))
        group = zarr.create_group(theirs, attributes=attributes)
        for name, entry in variables.items():
            group.create_array(
                name,
                shape=shape,
                chunks=chunks,
                dtype=entry.dtype,
                fill_value=voids[name],
                compressors=compressors(),
                dimension_names=dims,
                attributes=entry.attrs,
            )
        zarr.consolidate_metadata(theirs)
        assert written(ours) == written(theirs)


def written(store: Path) -> dict[str, bytes]:
    return {path.relative_to(store).as_posix(): path.read_bytes() for path in store.rglob("*") if path.is_file()}

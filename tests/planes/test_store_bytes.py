"""Chunks of a store are, byte for byte, those that zarr would have written."""

import tempfile
from pathlib import Path

import zarr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vijax.planes.store import compressors, encoded

KINDS = st.sampled_from(["<f8", "<f4", "<i4", "|i1", "|b1"])
SHAPES = arrays.array_shapes(max_dims=3, max_side=9)


@given(chunk=arrays.arrays(KINDS, SHAPES), turned=st.booleans())
def test_an_encoded_chunk_is_zarrs_own(chunk, turned):
    chunk = chunk.T if turned else chunk
    with tempfile.TemporaryDirectory() as folder:
        array = zarr.create_array(folder, data=chunk, chunks=chunk.shape, compressors=compressors(), fill_value=None)
        array.with_config({"write_empty_chunks": True})[...] = chunk
        (written,) = (path for path in Path(folder, "c").rglob("*") if path.is_file())
        assert encoded(chunk) == written.read_bytes()

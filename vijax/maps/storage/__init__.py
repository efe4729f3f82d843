"""Maps on disk: zarr stores with checksums, written atomically, tile by tile, and resumed after an interruption.

Begin with `store`, then `tiled_store`.
"""

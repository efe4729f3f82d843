"""What JAX, the machine and the disk ask of us; no physics.

Kernels of XLA, small linear systems, padded tiles of calls, programs kept on disk, files written whole, checks of
arguments. Begin with `tiles`, by which computations on many rows are called.
"""

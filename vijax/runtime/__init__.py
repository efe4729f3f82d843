"""Services for JAX, the machine and the disk, independent of the physics.

Compiled programs and their cache (`compilation`), numerical methods (`numerics`), padded tiles of calls, files written
atomically, validation of arguments. Begin with `tiles`, which calls compiled programs on any number of rows.
"""

"""Compilation of programs by XLA.

Constructs that control it, programs traced once for all processes, and their cache on disk. Begin with `programs`,
then `xla`.
"""

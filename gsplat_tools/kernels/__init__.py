"""numba only: arrays and scalars in, results into arrays given; no checks, no I/O, no classes."""

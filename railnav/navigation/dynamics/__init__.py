"""How a hypothesis moves from one epoch to the next, and how one reading changes it; all of it in `_kernels`."""

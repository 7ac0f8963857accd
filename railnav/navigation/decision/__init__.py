"""What is said at each epoch: track, mode, protection level; all of it in `_kernels`."""

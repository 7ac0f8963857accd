"""Whether the train stands: the wheels and the receiver watched; all of it in `_kernels`."""

"""The host around the training program: compiling, devices, memory, checkpoints, signals, progress, search."""

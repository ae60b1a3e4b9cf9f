"""The training program: pure functions of keys, states and environments. It reads no file and knows no host."""

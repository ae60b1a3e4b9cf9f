def solve(inertia, damping, force, rows, start, steps):
    return start, start

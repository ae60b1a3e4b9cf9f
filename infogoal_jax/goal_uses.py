"""What a goal is used for, and how many there may be. Files of questions, of splits and of images are checked by it, so
that this is known without JAX."""

USES = ("train", "validation", "test")
TRAINING, VALIDATION, TEST = range(len(USES))  # Their positions, which arrays of uses hold.
NO_USE = -1  # Of a goal that is neither a training, a validation nor a test goal: it can be achieved only.
MOST_GOALS = 8192
"""Of a task: the dissimilarity matrix takes N^2 bytes a seed."""

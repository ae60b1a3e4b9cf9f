"""What a goal is used for. Files of questions and of splits name it, so that this is known without JAX."""

USES = ("train", "validation", "test")
TRAINING, VALIDATION, TEST = range(len(USES))  # Their positions, which arrays of uses hold.
NO_USE = -1  # Of a goal that is neither a training, a validation nor a test goal: it can be achieved only.

"""Putting the parts together: the training program, the host loop around it, and the command line."""

from infogoal_jax.train.program import Train, TrainResult, TrainState, make_train

__all__ = ["Train", "TrainResult", "TrainState", "make_train"]

"""Putting the parts together: the training program and the host loop around it."""

from infogoal_jax.train.program import Train, TrainResult, TrainState, make_train

__all__ = ["Train", "TrainResult", "TrainState", "make_train"]

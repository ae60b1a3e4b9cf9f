"""What stands in for an environment in a process that was forked from one in which JAX had started, such as a worker of
Gymnasium's `AsyncVectorEnv`: nothing could be computed there."""

from typing import Any

import gymnasium

from infogoal_jax import checks


class Refusing(gymnasium.spaces.Dict):
    """A space that raises `checks.not_forked` when it is compared. Workers compare spaces first, and hand that error to
    their parent; what is raised while an environment is made they lose."""

    __hash__ = None

    def __eq__(self, other: Any) -> bool:
        checks.not_forked()
        return super().__eq__(other)


class RefusesForks:
    """An environment that says what is wrong once it is used where it cannot be."""

    def __getattr__(self, name: str) -> Any:
        checks.not_forked()
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def is_refused(self) -> bool:
        """Whether nothing can be computed in this process; then only spaces are made."""
        if checks.Fork.jax_had_started:
            self.observation_space = self.action_space = Refusing()
        return checks.Fork.jax_had_started

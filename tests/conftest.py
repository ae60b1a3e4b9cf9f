"""What several test files share because it takes long to compile."""

import pytest

from infogoal_jax import presets
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.train import host


@pytest.fixture(scope="session")
def reach_run(tmp_path_factory) -> host.Sweep:
    """Two seeds of FetchReach with image goals, trained for two epochs on episodes of 10 steps: nothing is learned, everything is there."""
    config = presets.load(
        "fetch_reach", env=FetchConfig(goals="images", episode_length=10), num_epochs=2, epochs_per_evaluation=1, num_envs=8, rollout_steps=10,
        updates_per_epoch=2, batch_size=16, buffer_steps=160, evaluation_starts=1,
    )
    return host.run(config, [0, 1], tmp_path_factory.mktemp("reach") / "run")

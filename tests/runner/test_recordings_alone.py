"""Recordings alone: a task that nobody can act in is learned from, and never said to have been evaluated."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, envs, evaluate, load_run, make_train, presets, rollout
from infogoal_jax.bridges.gymnasium import TaskGymnasium
from infogoal_jax.cli.main import main
from infogoal_jax.data.episodes import Episodes, of_arrays
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.envs.recordings import with_recordings
from infogoal_jax.goals import GoalBox
from infogoal_jax.report.comparison_figures import draw_comparison
from infogoal_jax.report.figures import draw_figures, read_subject
from infogoal_jax.report.summary import evaluate_run, print_run
from infogoal_jax.report.video import policy_video
from infogoal_jax.runner import training
from infogoal_jax.runner.search import tune


def walks() -> Episodes:
    """Two episodes of four steps."""
    places = np.random.default_rng(0).uniform(-1, 1, (10, 2)).astype(np.float32)
    return of_arrays({"observations": places, "actions": places, "terminals": np.arange(10) % 5 == 4})


def test_what_nobody_can_act_in_is_not_evaluated(tmp_path, capsys):
    """A run of recordings alone learns, is reported and compared without a success; whoever asks for one is told why
    there is none, and what to do instead."""
    presets.register("recorded_alone", envs.from_recordings(walks()), presets.OGBENCH)
    short = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 1, "batch_size": 4}
    config = presets.load("recorded_alone", "none", agent="gcivl", **short)
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, hidden=(8,)))
    found = training.run(config, [0], tmp_path / "run")
    assert "success_rate" not in (tmp_path / "run" / "evaluations.csv").read_text()
    print_run(found.folder)
    assert "not evaluated: there are recordings alone" in " ".join(capsys.readouterr().out.split())
    assert draw_figures(found.folder) == [] and draw_comparison([found.folder], tmp_path / "loss.png").exists()
    assert main(["pack", str(found.folder), "--out", str(tmp_path / "run.zip")]) == 0
    assert f"for example: infogoal compare {tmp_path / 'run.zip'}" in capsys.readouterr().out
    env, policy = found.train.env, found.train.policy(load_run(found.folder).params(), config.hyper, found.train.env)
    asked = [
        lambda: evaluate_run(found.folder, 1, 1, -1.0),
        lambda: evaluate(policy, env, env.goals.evaluated),
        lambda: rollout(env, policy, env.goals.evaluated[0], jax.random.key(0)),
        lambda: found.train.evaluate(found.params, config.hyper, env, 1),
        lambda: policy_video(read_subject(found.folder), tmp_path / "a.mp4"),
        lambda: tune(config, 1, [1000], jax.random.key(0)),
        lambda: TaskGymnasium(env),
    ]
    for ask in asked:
        with pytest.raises(UserError, match="recordings alone.*infogoal export"):
            ask()
    with pytest.raises(UserError, match=r"^env.simulated = False: give recordings"):
        presets.register("nothing", env.replace(recorded=None))


def test_goals_that_are_held_out_of_recordings_are_not_learned():
    """Each episode is for a recorded state, since a drawn vector need not be one; goals that are met on the way are
    learned unless the protocol forbids it, which is asked for."""
    task = envs.from_recordings(walks(), held_out=lambda goal: goal[0] > 0)
    desired = np.asarray(task.recorded.desired_goal)[:, 0]
    places = walks().observations
    assert (desired[:, 0] <= 0).all() and all((place == places).all(1).any() for place in desired)
    presets.register("held_out_alone", task, presets.OGBENCH)
    with pytest.raises(UserError, match="^known_goals = 'visited': the recordings would teach the goals"):
        make_train(presets.load("held_out_alone", "none", agent="gcivl"), task)
    make_train(presets.load("held_out_alone", "none", agent="gcivl", known_goals="held_out"), task)
    with pytest.raises(UserError, match="^held_out = 'every recorded state': leave some"):
        envs.from_recordings(walks(), held_out=lambda goal: jnp.abs(goal[0] - places[:, 0]).min() < 1e-6)


class Told(GoalTask):
    """A task whose source is settled by its class."""

    action_size = 2
    source = "a plane"

    def begin(self, key):
        return self.goals.draw(key)

    def observation(self, world):
        return world

    achieved_in = achieved_goal = observation


def test_a_run_tells_the_recordings_of_a_task_that_settles_its_source():
    """By which it does not go on with others."""
    task, others = Told(GoalBox.of([-1, -1], [1, 1])), walks()
    others.observations[3] += 0.1
    aimed = dataclasses.replace(walks(), desired_goals=np.zeros((10, 2), np.float32))
    config = presets.load("point_maze", "none", agent="gcivl")
    told = [training.describe(config, with_recordings(task, each), [0]).data for each in (walks(), others, aimed)]
    assert told[0] == training.describe(config, with_recordings(task, walks()), [0]).data and len(set(told)) == 3
    assert told[0].startswith("a plane; learned from recordings ")
    assert training.describe(config, task, [0]).data == "a plane"

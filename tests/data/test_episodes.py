"""Recorded episodes in OGBench's layouts: what is read is what was recorded, and everything wrong is said at once."""

import dataclasses
import functools
import io
import zipfile
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, envs, jit, make_train, presets
from infogoal_jax.agents.offline_crl import OfflineCRLConfig
from infogoal_jax.bridges.minari import episodes_of
from infogoal_jax.cli.main import main
from infogoal_jax.data import episodes
from infogoal_jax.data.episodes import Episodes, check_episodes, load, of_arrays, save
from infogoal_jax.envs.environment import data_of
from infogoal_jax.envs.recordings import from_recordings, with_recordings
from infogoal_jax.goals import GoalBox
from infogoal_jax.replay import Trajectories, steps_left
from infogoal_jax.runner import memory
from infogoal_jax.runner.memory import bytes_of
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import sample

LENGTHS = (3, 1, 5)
"""Steps of the episodes."""
ENDS = np.cumsum(np.array(LENGTHS) + 1) - 1


def recorded(**changes) -> dict[str, np.ndarray]:
    """Members of a file: an observation is 10 * episode + step, an action a tenth of that, as OGBench writes them."""
    seen = np.concatenate([10 * number + np.arange(length + 1) for number, length in enumerate(LENGTHS)])
    terminals = np.zeros(len(seen), np.float32)
    terminals[ENDS] = 1
    observations = np.stack([seen, -seen], 1).astype(np.float32)
    return {"observations": observations, "actions": observations[:, :1] / 100, "terminals": terminals} | changes


def in_memory(kind: str) -> dict[str, np.ndarray]:
    """What `ogbench.load_dataset` makes of the file: its own lines, on these members."""
    dataset = recorded()
    following = np.concatenate([dataset["terminals"][1:], [1.0]])
    if kind == "compact":
        return dataset | {
            "valids": 1.0 - dataset["terminals"],
            "terminals": np.minimum(dataset["terminals"] + following, 1.0),
        }
    inside = (1.0 - dataset["terminals"]).astype(bool)
    led_to = np.concatenate([[False], inside[:-1]])
    return {
        "next_observations": dataset["observations"][led_to],
        "observations": dataset["observations"][inside],
        "actions": dataset["actions"][inside],
        "terminals": following[inside],
    }


def test_a_file_is_read_as_it_was_written(tmp_path):
    made = of_arrays(recorded())
    save(tmp_path / "walks.npz", made)
    read = load(tmp_path / "walks.npz")
    assert read.lengths.tolist() == list(LENGTHS)
    for name, array in recorded().items():
        assert np.array_equal(read.members()[name], array)
    assert check_episodes(tmp_path / "walks.npz") == []


@pytest.mark.parametrize("kind", ["compact", "regular"])
def test_the_layouts_in_memory_are_the_same_episodes(kind):
    found, expected = of_arrays(in_memory(kind)), of_arrays(recorded())
    assert np.array_equal(found.observations, expected.observations) and np.array_equal(found.last, expected.last)
    assert np.array_equal(found.actions[~found.last], expected.actions[~found.last])


def test_images_stay_bytes():
    images = np.arange(len(recorded()["actions"]) * 48, dtype=np.uint8).reshape(-1, 4, 4, 3)
    made = Episodes(images, recorded()["actions"], recorded()["terminals"])
    assert made.observations.dtype == np.uint8 and "4 x 4 x 3 uint8" in episodes.describe(made)


SEEN = recorded()["observations"]
HOLE = np.where(np.arange(len(SEEN))[:, None] == 4, np.nan, SEEN).astype(np.float32)
FAULTS = {
    "another version": ({"format_version": np.array(2)}, ["format_version = 2: this program reads 1"]),
    "a version that is none": ({"format_version": np.array(0.0)}, ["format_version = 0.0: this program reads 1"]),
    "a member is missing": ({"actions": None}, ["actions: missing"]),
    "nan": ({"observations": HOLE}, ["observations[4]: is [nan, nan]; give finite numbers for float32"]),
    "too large for float32": (
        {"observations": SEEN.astype(np.float64) * 1e300},
        ["give finite numbers for float32", "1 more rows"],
    ),
    "whole numbers": ({"observations": SEEN.astype(np.int64)}, ["observations: is int64; give float"]),
    "records": ({"terminals": np.zeros(12, [("a", "i8")])}, ["terminals: is [('a', '<i8')]; give 0 or 1"]),
    "one axis": ({"observations": SEEN[:, 0]}, ["observations: has the shape [12]; give [rows, numbers"]),
    "complex": ({"actions": SEEN + 1j}, ["actions: is complex64; give float"]),
    "whole numbers of vectors": ({"actions": np.zeros((12, 1), np.int32)}, ["actions: is int32; give float"]),
    "moves below 0": ({"actions": -np.arange(12)}, ["actions[1]: is -1; moves have numbers from 0 on"]),
    "moves beyond any": (
        {"actions": np.arange(12) + 2**32},  # Which int32 would hold as 0 and on.
        ["actions[0]: is 4294967296; moves have numbers from 0 on, below 65,536"],
    ),
    "bounds of moves": (
        {"actions": np.arange(12), "action_bounds": np.array([[0.0], [1.0]])},
        ["action_bounds: is of actions that are vectors, and these are moves; leave it out"],
    ),
    "large actions": ({"actions": SEEN}, ["and 10 rows go beyond -1 to 1"]),
    "lengths": ({"actions": np.zeros((11, 1))}, ["actions: has 11 rows, but observations has 12"]),
    "no end": ({"terminals": np.zeros(12)}, ["terminals: no episode ends"]),
    "open end": ({"terminals": np.eye(12)[5]}, ["terminals[11]: is 0: the last 6 observations"]),
    "images of floats": (
        {"observations": np.zeros((12, 8, 8, 3), np.float32)},
        ["observations: is float32; give uint8: (255 * it).round().astype(np.uint8)"],
    ),
    "channels first": (
        {"observations": np.zeros((12, 3, 8, 8), np.uint8)},
        ["observations: is [12, 3, 8, 8], more channels than rows; give [N, H, W, C]"],
    ),
    "bounds the other way round": (
        {"action_bounds": np.array([[1.0], [-1.0]])},
        ["action_bounds: is [[1.0], [-1.0]]; give the lowest actions, then the highest"],
    ),
    "bounds of other actions": (
        {"action_bounds": np.array([[0.0, 0.0], [1.0, 1.0]])},
        ["action_bounds: has 2 numbers of an action, but actions has 1"],
    ),
    "other marks": ({"terminals": np.full(12, 2.0)}, ["terminals[0]: is 2.0; give 0 or 1"]),
    "nothing but ends": ({"terminals": np.ones(12)}, ["terminals: no episode has a step"]),
    "nothing": (
        {"observations": np.zeros((0, 2)), "actions": np.zeros((0, 1)), "terminals": np.zeros(0)},
        ["observations: has no rows; give"],
    ),
    "goals": ({"achieved_goals": np.zeros(12)}, ["achieved_goals: has the shape [12]; give [rows, numbers"]),
    "all at once": (
        {"observations": HOLE, "actions": np.full((11, 1), 3.0), "terminals": np.zeros(12)},
        ["observations[4]", "actions: has 11 rows, but observations has 12", "no episode"],
    ),
    "short, and not finite": (
        {"observations": HOLE, "actions": np.full((11, 1), np.inf)},
        ["observations[4]", "actions[0]: is [inf]", "actions: has 11 rows, but observations has 12"],
    ),
    "short beside what is of another type": (
        {"observations": SEEN.astype(np.int64), "actions": np.zeros((11, 1)), "terminals": np.eye(11)[10]},
        ["observations: is int64", "actions: has 11 rows, but obs", "terminals: has 11 rows, but observations has 12"],
    ),
    "two marks that contradict": (
        in_memory("compact") | {"valids": 1 - np.eye(12, dtype=np.float32)[[4, 11]].sum(0)},
        ["terminals[2]: is 1, but episodes end elsewhere by valids; leave one of both out"],
    ),
    "two layouts": (
        {"valids": 1 - recorded()["terminals"], "next_observations": SEEN},
        ["next_observations: goes without valids; leave one of both out"],
    ),
    "transitions that do not follow": (
        in_memory("regular") | {"next_observations": in_memory("regular")["observations"] + 5},
        ["next_observations[0]: is not the observation that follows, in 6 rows; mark the ends of episodes"],
    ),
    "transitions, two at once": (
        in_memory("regular") | {"actions": np.full((9, 1), 2.0), "terminals": np.zeros(9), "desired_goals": SEEN[:9]},
        [
            "actions[0]: is [2.0]",
            "terminals: no episode ends; mark the last of its transitions by 1",
            "desired_goals: g",
        ],
    ),
    "compact, two at once": (
        in_memory("compact") | {"actions": np.full((12, 1), 2.0), "valids": np.ones(12)},
        ["actions[0]: is [2.0]", "valids: no episode ends; mark the last of its observations by 0"],
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_everything_that_is_wrong_is_said_in_one_pass(name, tmp_path):
    changes, said = FAULTS[name]
    members = {member: array for member, array in recorded(**changes).items() if array is not None}
    file = tmp_path / "walks.npz"
    np.savez(file, **members)
    found = [f"{finding.where.removeprefix(f'{file}: ')}: {finding.problem}" for finding in check_episodes(file)]
    for words in said:
        assert any(words in line for line in found), found
    with pytest.raises(UserError) as refused:
        load(file)
    assert str(file) in str(refused.value) and "\n" not in str(refused.value)


def test_marks_of_another_length_are_one_fault(tmp_path):
    np.savez(tmp_path / "walks.npz", **recorded(terminals=np.eye(14)[5]))
    (found,) = check_episodes(tmp_path / "walks.npz")
    assert found.problem.startswith("has 14 rows, but observations has 12")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"observations": SEEN.astype(np.float64) * 1e-3 + 1e6},
            "observations: is float64; float32 rounds its column 0",
        ),
        ({"terminals": np.eye(12)[11]}, "terminals: all is one episode"),
    ],
)
def test_what_may_not_be_meant_is_a_warning(changes, said, tmp_path):
    np.savez(tmp_path / "walks.npz", **recorded(**changes))
    (found,) = check_episodes(tmp_path / "walks.npz")
    assert found.severity == "warning" and said in f"{found.where}: {found.problem}"


def test_what_does_not_vary_is_not_called_rounded(tmp_path):
    """A column of one number has a spread of rounding alone."""
    np.savez(tmp_path / "walks.npz", **recorded(observations=np.insert(SEEN.astype(np.float64), 0, 0.42, 1)))
    assert check_episodes(tmp_path / "walks.npz") == []


def test_one_transition_is_an_episode():
    one = {"observations": SEEN[:1], "next_observations": SEEN[1:2], "actions": np.zeros((1, 1)), "terminals": [1]}
    found = of_arrays(one)
    assert found.lengths.tolist() == [1] and np.array_equal(found.observations, SEEN[:2])


IN_MEMORY = {
    "texts": ({"valids": np.array(["x"] * 12)}, "valids: is <U1; give 0 or 1"),
    "no axis": ({"valids": np.zeros(())}, "valids: has the shape []"),
    "too few": ({"valids": np.zeros(5)}, "valids: has 5 rows, but observations has 12"),
    "transitions of texts": ({"next_observations": np.array(["x"] * 12)}, "next_observations: is <U1; give float"),
    "ends of no axis": ({"next_observations": SEEN, "terminals": np.zeros(())}, "terminals: has the shape []"),
    "actions of no axis": ({"next_observations": SEEN, "actions": np.zeros(())}, "actions: has the shape []"),
    "few actions": (
        {"next_observations": SEEN, "actions": np.zeros((3, 1))},
        "actions: has 3 rows, but observations has 12",
    ),
    "not finite": ({"next_observations": HOLE}, "next_observations[4]: is [nan, nan]; give finite"),
}


@pytest.mark.parametrize("name", IN_MEMORY)
def test_layouts_in_memory_are_looked_at_before_they_are_taken_apart(name, tmp_path):
    changes, said = IN_MEMORY[name]
    with pytest.raises(UserError) as refused:
        of_arrays(recorded(**changes))
    assert str(refused.value).startswith(said)
    np.savez(tmp_path / "walks.npz", **recorded(**changes))
    assert any(said in f"{finding.where}: {finding.problem}" for finding in check_episodes(tmp_path / "walks.npz"))


@pytest.mark.parametrize("values", [np.ma.masked_array(SEEN, SEEN > 3), [[0.5], [0.5, 0.5]]], ids=["masked", "ragged"])
def test_masks_and_ragged_lists_are_not_filled_in(values):
    with pytest.raises(UserError, match="observations.*(without a mask|of several shapes)"):
        of_arrays(recorded(observations=values))


@pytest.mark.parametrize("path", [None, 5, "", "a\0b"])
def test_what_is_no_path_is_refused(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for what in (lambda: load(path), lambda: save(path, of_arrays(recorded()))):
        with pytest.raises(UserError, match="(dataset|path) = "):
            what()
    with pytest.raises(UserError, match="episodes = 'int'"):
        save("walks.npz", 5)
    assert check_episodes(path)[0].severity == "error" and not list(tmp_path.iterdir())


def test_pickled_arrays_are_refused_and_what_is_no_npz(tmp_path):
    file = tmp_path / "walks.npz"
    np.savez(file, **recorded(actions=np.array([{}] * 12, object)))
    assert any("pickled" in finding.problem for finding in check_episodes(file))
    with pytest.raises(UserError, match="pickled"):
        load(file)
    file.write_bytes(b"nothing")
    assert "not an npz" in check_episodes(file)[0].problem
    buffer = io.BytesIO()
    np.savez(buffer, **recorded())
    file.write_bytes(buffer.getvalue()[:200])
    with pytest.raises(UserError, match=r"walks.npz.*npz"):
        load(file)
    assert not zipfile.is_zipfile(file)


def test_a_member_that_cannot_be_read_is_not_missing(tmp_path):
    file = tmp_path / "walks.npz"
    np.savez(file, **recorded(observations=np.array([[1], [2, 3]], object)))
    (found,) = check_episodes(file)
    assert "pickled objects, which run code" in found.problem


def test_a_member_that_nothing_reads_is_a_warning(tmp_path):
    file = tmp_path / "walks.npz"
    np.savez(file, **recorded(observations=SEEN.astype(np.float64), qpos=SEEN, desired_goal=SEEN))
    (found,) = check_episodes(file)
    assert found.severity == "warning" and "nothing reads it. Did you mean 'desired_goals'?" in found.problem


def test_the_command_says_what_is_in_a_file_and_what_it_takes(tmp_path, capsys):
    file = tmp_path / "walks.npz"
    np.savez(file, **recorded())
    assert main(["data", "check", str(file)]) == 0
    assert "3 episodes of 1 to 5 steps, 9 in all; observations 2 float32, actions 1; 0.0 MB" in capsys.readouterr().out
    np.savez(file, **recorded(actions=SEEN))
    assert main(["data", "check", str(file)]) == 2
    assert "error    " in capsys.readouterr().out


@pytest.mark.parametrize("lengths", [(5, 5), (7, 3, 2, 4)], ids=["equal", "of several lengths"])
@pytest.mark.parametrize("goals", [False, True])
def test_the_bytes_that_are_told_are_those_that_a_device_holds(lengths, goals):
    """Rows are as long as the longest episode, and hold each state up to three times."""
    ends = np.cumsum(np.array(lengths) + 1)
    seen = np.random.default_rng(0).uniform(-1, 1, (ends[-1], 2)).astype(np.float32)
    told = {"achieved_goals": seen, "desired_goals": abs(seen)} if goals else {}
    made = of_arrays(
        {"observations": seen, "actions": seen, "terminals": np.isin(np.arange(1, len(seen) + 1), ends)} | told
    )
    task = with_recordings(maze(), made) if goals else from_recordings(made)
    assert made.nbytes == bytes_of(task.recorded)


def test_recordings_larger_than_a_device_are_refused_before_they_lie_on_it(tmp_path, monkeypatch, capsys):
    """In one line of the file, with the bytes that it takes."""
    steps = 20_000
    seen = np.random.default_rng(0).uniform(-1, 1, (steps, 2)).astype(np.float32)
    save(
        tmp_path / "walks.npz",
        of_arrays({"observations": seen, "actions": seen, "terminals": np.arange(steps) % 100 == 99}),
    )
    put = jax.device_put

    def device_put(value, *given, **named):
        assert sum(getattr(leaf, "nbytes", 0) for leaf in jax.tree.leaves(value)) < 100_000
        return put(value, *given, **named)

    monkeypatch.setattr(jax, "device_put", device_put)
    monkeypatch.setattr(memory, "device_memory", lambda device: 1_000_000)
    words = ["train", "point_maze", "--method", "none", "--agent", "gciql", "--out", str(tmp_path / "run")]
    assert main([*words, "--env.dataset", str(tmp_path / "walks.npz")]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "env.dataset = " in said and "leave out some of its episodes" in said and not (tmp_path / "run").exists()


def test_recorded_moves_are_learned_from(tmp_path):
    """By the agents that choose among moves; one more than the largest that was recorded, or those of a task."""
    moves = np.arange(12) % 4
    made = of_arrays(recorded(observations=SIDE, actions=moves))
    save(tmp_path / "walks.npz", made)
    assert np.array_equal(load(tmp_path / "walks.npz").actions, moves) and "actions moves;" in episodes.describe(made)
    task = from_recordings(tmp_path / "walks.npz")
    assert task.discrete and task.action_size == 4 and task.recorded.action.dtype == np.int32
    with pytest.raises(UserError, match="actions = '4 moves': the task has 2 numbers in an action"):
        with_recordings(maze(), made)
    presets.register("recorded_moves", task, presets.OGBENCH)
    sizes = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 2, "batch_size": 8}
    config = presets.load("recorded_moves", "none", agent="cql", relabelling="her", **sizes)
    assert np.isfinite(jit(make_train(config, task))(jax.random.key(0)).epochs["agent/loss"]).all()
    with pytest.raises(UserError, match="has a few moves to choose from: give dqn or cql"):
        make_train(presets.load("recorded_moves", "none", **sizes), task)


GOALS = "achieved_goal", "desired_goal"


def of_minari(make_observations, actions=None) -> Episodes:
    """What is read of a dataset of Minari with two episodes, of 2 and 4 steps. make_observations: (steps) -> those of
    an episode."""
    recorded = [
        SimpleNamespace(
            observations=make_observations(steps),
            actions=np.full((steps, 2), 0.5) if actions is None else actions(steps),
        )
        for steps in (2, 4)
    ]
    return episodes_of(SimpleNamespace(iterate_episodes=lambda: iter(recorded)))


def numbers(steps: int, *shape: int) -> np.ndarray:
    """Numbers [steps + 1, *shape] that tell their step."""
    return np.arange(steps + 1.0).reshape(-1, *[1] * len(shape)) + np.zeros(shape)


def test_a_dataset_of_minari_becomes_a_file_by_one_command(tmp_path, monkeypatch, capsys):
    one = SimpleNamespace(observations=numbers(3, 2).astype(np.float32), actions=np.zeros((3, 2), np.float32))

    def load_dataset(name):
        if name != "there-v0":
            raise FileNotFoundError(f"{name} is not here\nand more")
        return SimpleNamespace(iterate_episodes=lambda: iter([one]))

    library = SimpleNamespace(load_dataset=load_dataset)
    monkeypatch.setattr("infogoal_jax.bridges.minari.import_minari", lambda: library)
    out = tmp_path / "walks.npz"
    assert main(["data", "import-minari", "there-v0", "--out", str(out)]) == 0
    assert "1 episodes of 3 steps" in capsys.readouterr().out and load(out).lengths.tolist() == [3]
    assert main(["data", "import-minari", "gone-v0", "--out", str(tmp_path / "none.npz")]) == 2
    error = capsys.readouterr().err
    assert "name = 'gone-v0': Minari cannot load it (gone-v0 is not here); fetch it" in error and error.count("\n") == 1
    assert not (tmp_path / "none.npz").exists()


def test_minari_s_goal_envs_bring_their_goals():
    names = {"observation": 3, "achieved_goal": 2, "desired_goal": 2}
    found = of_minari(lambda steps: {name: numbers(steps, size) for name, size in names.items()})
    assert found.lengths.tolist() == [2, 4] and found.observations.shape == (8, 3)
    assert found.observations[:, 0].tolist() == [0, 1, 2, 0, 1, 2, 3, 4] == found.achieved_goals[:, 1].tolist()
    assert np.array_equal(found.actions[:, 0], 0.5 * ~found.last)


def test_minari_s_vectors_dictionaries_and_images_are_read():
    assert of_minari(lambda steps: numbers(steps, 3)).observations.shape == (8, 3)
    together = of_minari(lambda steps: {"b": numbers(steps, 1) + 10, "a": numbers(steps, 2)})
    assert together.observations[1].tolist() == [1, 1, 11] and together.achieved_goals is None


@pytest.mark.parametrize(
    ("shape", "read"),
    [
        ((8, 8, 3), (8, 8, 3)),
        ((3, 8, 8), (8, 8, 3)),
        ((8, 9), (8, 9, 1)),
        ((4, 84, 84), (84, 84, 4)),
        ((9, 64, 64), (64, 64, 9)),
        ((4, 16, 16, 3), (16, 16, 12)),
        ((4, 3, 16, 16), (16, 16, 12)),
    ],
)
def test_minari_s_images_and_stacks_of_them_stay_bytes(shape, read):
    """With channels last; the frames of a stack one behind the other."""
    given = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    images = of_minari(lambda steps: np.stack([given] * (steps + 1))).observations
    assert images.dtype == np.uint8 and images.shape == (8, *read)
    frames = given if given.ndim == 4 else given[None]
    last = [frame if frame.shape[-1] == 3 or frame.ndim == 2 else np.moveaxis(frame, 0, -1) for frame in frames]
    assert np.array_equal(images[5], np.concatenate([each.reshape(*read[:2], -1) for each in last], -1))
    assert np.array_equal(of_minari(lambda steps: {"pixels": np.stack([given] * (steps + 1))}).observations, images)


def test_minari_s_moves_begin_at_0():
    space = SimpleNamespace(start=3, n=4)
    one = SimpleNamespace(observations=numbers(3, 2), actions=np.array([3, 6, 4]))
    found = episodes_of(SimpleNamespace(action_space=space, iterate_episodes=lambda: [one]))
    assert found.moves and found.actions.tolist() == [0, 3, 1, 0] and found.action_bounds is None
    one.actions = one.actions + 2**33
    with pytest.raises(UserError, match=r"actions\[0\]: is 8589934592; moves have numbers"):
        episodes_of(SimpleNamespace(action_space=space, iterate_episodes=lambda: [one]))


@pytest.mark.parametrize(
    ("make_observations", "actions", "said"),
    [
        (lambda steps: numbers(steps, 3), lambda steps: np.zeros(steps), "actions = [2]: give a vector for each"),
        (
            lambda steps: numbers(steps, 3),
            lambda steps: np.zeros(steps + 1, int),
            "actions = [3]: give a move for each",
        ),
        (lambda steps: numbers(steps, steps), None, "episodes of different shapes"),
        (
            lambda steps: {"a": numbers(steps, 8, 8, 3).astype(np.uint8), "b": numbers(steps, 2)},
            None,
            "observations = {'a': [3, 8, 8, 3], 'b': [3, 2]}: give a vector for each step under each key, or one image",
        ),
        (
            lambda steps: {"a": numbers(steps, 2), "b": numbers(steps + 1, 2)},
            None,
            "observations = {'a': [3, 2], 'b': [4, 2]}: give a vector",
        ),
        (lambda steps: {}, None, "observations = {}: give a vector"),
        (
            lambda steps: {key: {"door": numbers(steps, 8, 8), "kettle": numbers(steps, 2)} for key in GOALS},
            None,
            "achieved_goals = {'door': [3, 8, 8], 'kettle': [3, 2]}: give a vector for each step under each key",
        ),
        (
            lambda steps: dict(zip(GOALS, ({"kettle": 0}, {"door": 0}), strict=True)),
            None,
            "desired_goals = ['door']: give the keys of achieved_goals, ['kettle']",
        ),
        (
            lambda steps: {key: {"kettle": np.array(["on"] * (steps + 1))} for key in GOALS},
            None,
            "achieved_goals['kettle'] = '<U2': give numbers",
        ),
        (lambda steps: np.array(["text"] * (steps + 1)), None, "observations = '<U4': give numbers"),
        (lambda steps: [[0.0], [0.0, 0.0]] * steps, None, "observations: give an array, not list of several shapes"),
        (lambda steps: numbers(steps, 3), lambda steps: {"a": 0}, "actions = 'object': give numbers"),
        (lambda steps: dict.fromkeys(GOALS, 0), None, "achieved_goals = 'int64': give numbers"),
    ],
)
def test_what_cannot_be_read_of_minari_is_one_line(make_observations, actions, said):
    with pytest.raises(UserError) as refused:
        of_minari(make_observations, actions)
    assert said in str(refused.value) and "\n" not in str(refused.value)


@functools.cache
def maze():
    """Loaded by those that need it: dozens of small programs."""
    return envs.load("point_maze")


SIDE = np.random.default_rng(0).uniform(-1, 1, (12, 2)).astype(np.float32)


def test_rows_hold_every_step_of_every_episode_once_and_none_across_two():
    task = with_recordings(maze(), of_arrays(recorded(observations=SIDE, actions=SIDE)))
    rows = jax.device_get(task.recorded)
    assert rows.valid.sum() == sum(LENGTHS) and rows.truncated.sum() == len(LENGTHS)
    row, step = np.nonzero(rows.valid)
    where = {tuple(seen): place for place, seen in enumerate(SIDE.tolist())}
    before = [where[tuple(seen)] for seen in rows.observation[row, step].tolist()]
    after = [where[tuple(seen)] for seen in rows.observation[row, step + 1].tolist()]
    assert sorted(before) == sorted({*range(12)} - {*ENDS}) and np.array_equal(np.array(before) + 1, after)
    assert np.array_equal(rows.action[row, step], SIDE[before])
    assert np.allclose(rows.record, (rows.observation + 1) * 1.5)  # What a place in the maze achieves.
    left = np.asarray(steps_left(task.recorded.valid))[row, step]
    ends = np.array([ENDS[np.searchsorted(ENDS, place)] for place in before])
    assert np.array_equal(left, ends - before)
    goals = {tuple(goal) for goal in rows.desired_goal[rows.valid].tolist()}
    assert len(goals) == len(LENGTHS)  # One for each episode, where none is recorded.


def test_goals_of_a_goal_env_are_taken_as_they_are():
    goals = {"achieved_goals": SIDE, "desired_goals": SIDE + 1}
    rows = with_recordings(maze(), of_arrays(recorded(observations=SIDE, actions=SIDE, **goals))).recorded
    assert np.array_equal(rows.record, rows.observation)
    assert np.allclose(np.asarray(rows.desired_goal)[rows.valid], np.asarray(rows.observation)[:, :-1][rows.valid] + 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"observations": np.zeros((12, 3), np.float32)}, "observations = 'float32 [3]': the task has float32 [2]"),
        ({"actions": np.zeros((12, 3), np.float32)}, "actions = 3: the task has 2 numbers in an action"),
        ({"achieved_goals": np.zeros((12, 1))}, "achieved_goals = [12, 1]: give goals float32 [N, 2]"),
        ({"desired_goals": np.full((12, 2), 9.0)}, "desired_goals = [9.0, 9.0]: lies outside; give"),
    ],
)
def test_recordings_of_another_task_are_refused(changes, said):
    with pytest.raises(UserError) as refused:
        with_recordings(maze(), of_arrays(recorded(**({"observations": SIDE, "actions": SIDE} | changes))))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("achieved_in", "said"),
    [
        (lambda self, seen: seen[:1], "^achieved_in: is float32 .1.; give float32 .2.$"),
        (lambda self, seen: seen / 0, "^achieved_in = .*inf.*: return finite numbers"),
        (lambda self, seen: missing, "^achieved_in: raised NameError"),  # noqa: F821
    ],
)
def test_what_reads_no_goals_from_observations_is_refused(achieved_in, said):
    kind = type("Wrong", (type(maze()),), {"achieved_in": achieved_in})
    with pytest.raises(UserError, match=said):
        with_recordings(kind(maze().goals), of_arrays(recorded(observations=SIDE, actions=SIDE)))


def recorded_in(rows: Trajectories) -> Episodes:
    """The episodes of rows that a task with continuous goals was collected in, to be saved: those of at least one
    step."""
    rows = jax.device_get(rows)
    follows = rows.valid  # [R, T], whether an observation is followed by the next of its episode.
    led_to = np.pad(follows, ((0, 0), (1, 0)))
    goes_on = np.pad(follows, ((0, 0), (0, 1)))
    kept = led_to | goes_on
    action = np.pad(rows.action, ((0, 0), (0, 1), (0, 0)))
    # The last observation of an episode has the goal of the transition that led to it.
    before, after = ((0, 0), (0, 1), (0, 0)), ((0, 0), (1, 0), (0, 0))
    goal = np.where(goes_on[..., None], *(np.pad(rows.desired_goal, places) for places in (before, after)))
    return Episodes(rows.observation[kept], action[kept], ~goes_on[kept], rows.record[kept], goal[kept])


def test_what_is_collected_can_be_recorded_and_learned_from(tmp_path):
    """To the same transitions, by the command line too."""

    def wander(observation, goal, key):
        return jax.random.uniform(key, (observation.shape[0], 2), jnp.float32, -1.0, 1.0)

    states = jax.jit(jax.vmap(maze().reset))(jax.random.split(jax.random.key(0), 3))
    rows = jax.jit(lambda states, key: collect(maze(), states, wander, key, 150)[1])(states, jax.random.key(1))
    made = recorded_in(rows)
    save(tmp_path / "walks.npz", made)
    task = envs.load("point_maze", envs.plane.PlaneConfig(dataset=str(tmp_path / "walks.npz")))
    again = jax.device_get(task.recorded)

    def steps(rows):
        row, step = np.nonzero(np.asarray(rows.valid))
        observation = np.asarray(rows.observation)
        parts = observation[row, step], rows.action[row, step], observation[row, step + 1]
        found = np.concatenate([*parts, rows.desired_goal[row, step]], 1)
        return found[np.lexsort(found.T)]

    assert np.array_equal(steps(rows), steps(again)) and made.lengths.sum() == rows.valid.sum()
    assert "learned from recordings" in data_of(task)
    with pytest.raises(UserError, match=r"^env.dataset = '[^']*gone.npz': no such file"):
        envs.load("point_maze", envs.plane.PlaneConfig(dataset=str(tmp_path / "gone.npz")))


@pytest.mark.parametrize("name", ["", "a\0b", "\ud800.npz"], ids=["empty", "null byte", "half a character"])
def test_a_name_that_no_file_can_have_is_refused(name):
    with pytest.raises(UserError, match=r"^dataset = '.*give an npz with observations"):
        from_recordings(name)


def test_a_task_of_recordings_alone_has_states_as_goals():
    """As OGBench's: every state is a goal, seen as it is, and is achieved where it was recorded."""
    episodes = of_arrays(recorded(observations=SIDE, actions=SIDE))
    task = from_recordings(episodes)
    assert task.goals.shape == SIDE.shape[1:] and task.action_size == SIDE.shape[1]
    assert task.episode_length == episodes.lengths.max()  # A learner pairs goals within a window of an episode.
    rows = task.recorded
    assert np.array_equal(rows.record, rows.observation) and rows.valid.sum() == episodes.lengths.sum()
    goal = jnp.asarray(SIDE[3])
    assert task.reached(goal, goal) and np.array_equal(task.goals.inputs_of(goal), goal)
    assert not task.reached(jnp.nextafter(goal, jnp.inf), goal)  # In whatever units states are.


def test_goals_are_drawn_from_recorded_places_alone():
    """Of episodes of several lengths: what fills their rows is no achieved goal."""
    ends = np.cumsum([20, 3, 15, 4, 12, 20, 6, 15])
    seen = np.random.default_rng(0).uniform(5, 6, (ends[-1], 2)).astype(np.float32)
    task = from_recordings(Episodes(seen, seen - 5, np.isin(np.arange(1, len(seen) + 1), ends)))
    presets.register("several_lengths", task, presets.OGBENCH)
    train = make_train(presets.load("several_lengths", "infogoal", agent="gciql", batch_size=256), task)

    @jax.jit
    def drawn(key, env):
        setup = train.setup(env=env)
        experience, _ = make_experience(setup, train.initial(key, train.config.hyper, env), 0)
        known = experience.known.draw(key, (256,))
        return experience.achieved_count[-1], known, sample(setup, experience, key)

    count, known, batch = jax.device_get(drawn(jax.random.key(0), train.env))
    assert task.recorded.valid.shape == (6, 19) and count == len(seen)
    pairs, places = batch.pairs, {tuple(place) for place in seen.tolist()}
    negative = pairs.negative[pairs.negative_weight > 0]
    for goals in (known, batch.transitions.desired_goal, batch.actor_goal, pairs.anchor, pairs.positive, negative):
        assert {tuple(goal) for goal in goals.tolist()} <= places


def test_a_policy_of_minari_s_recordings_acts_between_the_bounds_that_they_had(tmp_path):
    """The file tells them: its own actions lie from -1 to 1, and so do those of the policy that learns from them."""
    low, high = np.array([0.0, -0.2], np.float32), np.array([3.0, 0.2], np.float32)
    walk = SimpleNamespace(observations=numbers(3, 2), actions=np.array([[0.0, 0.2], [3.0, -0.1], [1.5, 0.0]]))
    space = SimpleNamespace(low=low, high=high)
    save(tmp_path / "walks.npz", episodes_of(SimpleNamespace(action_space=space, iterate_episodes=lambda: [walk])))
    task, given = from_recordings(tmp_path / "walks.npz"), np.array([[-1, -1], [0, 0], [2, 1]], np.float32)
    assert np.array_equal(task.own_action(given), np.array([low, [1.5, 0.0], high], np.float32))
    plain = from_recordings(of_arrays(recorded(actions=np.zeros((12, 2)))))
    assert np.array_equal(plain.own_action(given), given)


def test_recordings_with_other_bounds_of_actions_than_the_task_s_are_refused():
    class Stronger(type(maze())):
        action_bounds = ((-2.0, -2.0), (2.0, 2.0))

    task = Stronger(maze().goals)
    for bounds, fits in ((2.0, True), (1.0, False)):
        own = np.array([[-bounds] * 2, [bounds] * 2], np.float32)
        made = of_arrays(recorded(observations=SIDE, actions=SIDE, action_bounds=own))
        if fits:
            assert with_recordings(task, made).recorded is not None
        else:
            with pytest.raises(UserError, match=r"action_bounds = .*-1.0.*: give recordings of the task, .*-2.0"):
                with_recordings(task, made)


def test_a_region_of_recorded_states_is_held_out():
    middle = float(np.median(SIDE[:, 0]))
    task = from_recordings(of_arrays(recorded(observations=SIDE, actions=SIDE)), held_out=lambda goal: goal[0] > middle)
    desired = np.asarray(jax.jit(jax.vmap(task.goals.draw))(jax.random.split(jax.random.key(0), 50)))
    assert (desired[:, 0] <= middle).all() and {"train", "test"} <= {*task.goals.groups}


@pytest.mark.parametrize(
    ("held_out", "said"),
    [
        (lambda goal: goal, r"^held_out = 'float32 \[2\]': return bool \[\]"),
        (lambda goal: True, "^held_out = '0% training goals': leave at least"),
        (lambda goal: 1 / 0, "^held_out: raised ZeroDivisionError"),
        (lambda: True, "^held_out = .*cannot be called with 1 arguments"),
    ],
)
def test_what_is_wrong_with_held_out_is_said_of_it(held_out, said):
    """`use_of` was named, the argument of the goal space that is made of it."""
    with pytest.raises(UserError, match=said):
        from_recordings(of_arrays(recorded(observations=SIDE, actions=SIDE)), held_out=held_out)


def test_recordings_for_goals_that_are_held_out_are_refused():
    places, task = abs(SIDE), maze()
    desired = of_arrays(recorded(observations=places, actions=SIDE, achieved_goals=places, desired_goals=places))
    assert with_recordings(task, desired).recorded is not None
    goals = GoalBox.of(task.goals.low, task.goals.high, use_of=lambda goal: goal[0] < 0.5)
    with pytest.raises(UserError, match=r"^desired_goals = .*: is held out of training; leave the member out"):
        with_recordings(task.replace(goals=goals), desired)


def spotted(goals):
    """Pictures of goals [..., 2], uint8 [..., 8, 8, 3]: as bright as the first number."""
    return jnp.broadcast_to(goals[..., :1, None, None], (*goals.shape[:-1], 8, 8, 3)).astype(jnp.uint8)


def test_goals_of_recorded_states_are_shown_as_pictures():
    task = from_recordings(of_arrays(recorded()), seen=spotted)
    shown = task.goals.inputs_of(jnp.asarray(recorded()["observations"]))
    assert shown.shape[1:] == (8, 8, 3) and np.array_equal(shown[:, 0, 0, 0], recorded()["observations"][:, 0])
    with pytest.raises(UserError, match=r"^seen = 'float32 \[\]'"):
        from_recordings(of_arrays(recorded()), seen=lambda goals: goals[..., 0])


def hiql_on_pictures(learner: str, see, held_out=None):
    """A program that learns from the recordings with pictures `see` of goals, two updates of four transitions."""
    task = from_recordings(of_arrays(recorded()), seen=see, held_out=held_out)
    presets.register("pictured", task, presets.OGBENCH)
    sizes = {"updates_per_epoch": 2, "batch_size": 4, "known_goals": "held_out"}
    config = presets.load("pictured", learner, agent="hiql", **sizes)
    small = {"latent_size": 4, "hidden": (8,)} | ({} if learner == "none" else {"num_pairs": 4, "window": 2})
    return make_train(
        dataclasses.replace(
            config,
            learner=dataclasses.replace(config.learner, **small),
            agent=dataclasses.replace(config.agent, hidden=(8,), size=4),
        ),
        task,
    )


def test_an_update_encodes_each_goal_once():
    """Of HIQL four: of the values, of the actor, of its low level, and the one on the way; that of the values by the
    target networks too."""
    shown = []

    def see(goals):
        shown.append(goals.shape[:-1])
        return spotted(goals)

    train = hiql_on_pictures("none", see)
    state = train.state_shapes
    shown.clear()
    jax.eval_shape(train.epochs, state, jnp.zeros(1, jnp.int32), train.config.hyper, train.env)
    assert shown == [(4,)] * 5


def test_what_contrastive_rl_takes_for_achieved_was_achieved_where_goals_are_held_out():
    """Each episode goes ahead by 1 a step; of its numbers every fifth is known, and none after the last of them."""
    line = np.arange(60, dtype=np.float32)
    seen = np.stack([line, line], 1)
    task = from_recordings(
        Episodes(seen, seen / 60, line % 20 == 19), held_out=lambda goal: jnp.abs(goal[0] % 5 - 1) > 0.45
    )
    presets.register("mostly_held_out", task, presets.OGBENCH)
    agent = OfflineCRLConfig(hidden=(8,), size=8)
    config = presets.load("mostly_held_out", "none", agent=agent, known_goals="held_out", batch_size=64)
    train = make_train(config, task)

    @jax.jit
    def drawn(key, env):
        experience, _ = make_experience(train.setup(env=env), train.initial(key, train.config.hyper, env), 0)
        return sample(train.setup(env=env), experience, key)

    batch = jax.device_get(drawn(jax.random.key(0), train.env))
    goals, here = batch.transitions.desired_goal[:, 0], batch.transitions.observation[:, 0]
    assert (goals % 5 == 1).all() and (goals > here).all() and (goals // 20 == here // 20).all()


@pytest.mark.long
def test_no_picture_of_a_goal_that_is_held_out_enters_training():
    shown = []

    def see(goals):
        jax.debug.callback(lambda goals: shown.append(np.asarray(goals).reshape(-1, 2)), goals)
        return spotted(goals)

    def held_out(goal):
        return (goal[0] > 9) & (goal[0] < 15)

    train = hiql_on_pictures("infogoal", see, held_out)
    state = train.initial(jax.random.key(0), train.config.hyper, train.env)
    shown.clear()
    jax.block_until_ready(jit(train.epochs)(state, jnp.arange(10, dtype=jnp.int32), train.config.hyper, train.env))
    jax.effects_barrier()
    goals = np.concatenate(shown)
    assert len({*goals[:, 0]}) > 5 and not jax.vmap(held_out)(goals).any()


def test_recordings_of_images_need_a_task():
    images = np.zeros((12, 8, 8, 3), np.uint8)
    with pytest.raises(UserError, match=r"observations = 'uint8 \[8, 8, 3\]': .*with_recordings"):
        from_recordings(of_arrays(recorded(observations=images)))

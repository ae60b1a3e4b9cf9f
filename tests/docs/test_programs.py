"""Programs that a reader runs. The learner, the agent and the task that docs/guides/own_parts.md, own_agent.md and
own_task.md make outside of the repository are complete, short, and do what the pages say, and so does the task of the
notebook your_own; the notebooks are saved with their pictures, and run from top to bottom at toy size."""

import base64
import contextlib
import dataclasses
import importlib.util
import io
import re
import runpy
import sys
import types

import hand_made
import jax
import jax.numpy as jnp
import nbformat
import numpy as np
import optax
import pytest
from places import DOCS, ROOT, block_of, in_hand_made_rooms, lines_of, run

import infogoal_jax
import infogoal_jax.bridges.brax  # Before brax, which then warns of nothing.
from infogoal_jax import envs, presets
from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.cli.main import main
from infogoal_jax.envs.environment import Environment
from infogoal_jax.runner.compilation import QUICKEST, flags
from infogoal_jax.train.evaluation import evaluate, random_policy

LEARNER, AGENT, TASK = "guides/own_parts.md", "guides/own_agent.md", "guides/own_task.md"
ROBOT = "guides/bridges.md#robots-of-brax,-playground-and-jaxgcrl"
OGBENCH = "reference/datasets.md#offline-from-recorded-episodes"
"""The pages."""
SMALL = {"evaluation_starts": 1}
LEARNER_SIZES = SMALL | {"num_epochs": 3, "epochs_per_evaluation": 3, "updates_per_epoch": 40, "batch_size": 16}
AGENT_SIZES = SMALL | {"num_epochs": 2, "epochs_per_evaluation": 2, "updates_per_epoch": 5}
LONG_SIZES = {
    "num_epochs": 12,
    "epochs_per_evaluation": 12,
    "updates_per_epoch": 100,
    "batch_size": 64,
    "evaluation_starts": 20,
}
QUANTILES = 8
DRAWS = {
    "quickstart": ("env", "curves", "codes", "path", "sweep"),
    "fetch_image_goals": ("curves", "goals", "corrupt", "video"),
    "seed_sweeps": ("curves", "pairs", "enough"),
    "your_own": ("task-figure", "compare", "dataset", "dataset-train"),
    "your_robot": ("curve", "goals"),
    "click": ("curve", "places"),
}
"""The cells of each notebook that end in a picture."""
PICTURES = ("image/png", "image/gif")
LARGEST = 600_000
"""Bytes of a saved notebook."""
each_notebook = pytest.mark.parametrize("name", DRAWS)


@pytest.mark.parametrize(("page", "lines"), [(LEARNER, 40), (AGENT, 80), (TASK, 60), (ROBOT, 10), (OGBENCH, 15)])
def test_a_page_needs_few_lines(page, lines):
    assert lines_of(block_of(page)) <= lines


@pytest.fixture(scope="module")
def own_learner() -> dict:
    """The names that the page's script leaves behind, run on the hand-made rooms instead of a house, with nothing else
    changed."""
    with run(block_of(LEARNER), prepare=in_hand_made_rooms(**LEARNER_SIZES), name_of_module="__main__") as names:
        yield names


@pytest.mark.long
def test_the_learners_loss_is_reported_under_its_name_and_falls(own_learner):
    pull, floor = (np.asarray(own_learner["result"].epochs[f"mine/{name}"]) for name in ("pull", "floor"))
    assert np.isfinite(pull).all() and pull.shape == (LEARNER_SIZES["num_epochs"],)
    assert (pull + floor)[-1] < 0.1 * (pull + floor)[0]


@pytest.mark.long
def test_goals_of_one_room_come_to_lie_together(own_learner):
    """Goals in view together are pulled together; the floor keeps the rooms apart. Under the agent's loss alone they
    lie about equally far."""
    result, train, config = own_learner["result"], own_learner["train"], own_learner["config"]
    assert presets.names_of(config)["learner"] == train.parts.name == "mine"
    codes = np.asarray(
        own_learner["make"](own_learner["MineConfig"]()).encode(result.params["goal"], train.env.goals.inputs).mean
    )
    room = np.asarray(train.env.goals.regions)
    distance = np.linalg.norm(codes[:, None] - codes[None], axis=-1)
    same = room[:, None] == room[None]
    within, between = distance[same & ~np.eye(len(room), dtype=bool)], distance[~same]
    assert within.mean() < 0.1 * between.mean()


@pytest.mark.parametrize(
    ("page", "flag", "field"),
    [(LEARNER, "--method mine", "--learner.window"), (AGENT, "--agent qr_dqn", "--agent.num-quantiles")],
)
def test_every_command_knows_a_part_of_a_file(page, flag, field, tmp_path, monkeypatch, capsys):
    """By the line of its page, which imports the block: nothing is trained by that."""
    monkeypatch.chdir(tmp_path)
    (line,) = re.findall(rf"^infogoal (.*--import (\w+\.py) {flag})$", (DOCS / page).read_text(), re.M)
    (tmp_path / line[1]).write_text(block_of(page))
    with pytest.raises(SystemExit):
        main([*line[0].split(), "--help-all"])
    assert field in capsys.readouterr().out


@pytest.mark.long
def test_a_window_of_the_learner_that_makes_no_sense_is_refused(own_learner):
    with pytest.raises(infogoal_jax.UserError, match="learner.window"):
        hand_made.config("none", learner=own_learner["MineConfig"](window=-1))


@pytest.fixture(scope="module")
def own_agent() -> dict:
    """The same of the agent's page."""
    with run(block_of(AGENT), prepare=in_hand_made_rooms(**AGENT_SIZES), name_of_module="__main__") as names:
        yield names


@pytest.mark.long
def test_the_agent_trains_with_infogoal_and_reports_the_spread(own_agent):
    result, config = own_agent["result"], own_agent["config"]
    assert presets.names_of(config)["agent"] == "qr_dqn" and presets.names_of(config)["learner"] == "infogoal"
    assert np.asarray(result.epochs["agent/spread"]).shape == (AGENT_SIZES["num_epochs"],)
    assert all(np.isfinite(values).all() for values in jax.tree.leaves((result.epochs, result.params)))


@pytest.mark.long
def test_the_agent_learns_its_training_goals():
    """Twice as often as a random policy reaches them."""
    with run(block_of(AGENT), prepare=in_hand_made_rooms(**LONG_SIZES), name_of_module="__main__") as names:
        env, success = names["train"].env, names["result"].metrics["train_goal/success_rate"][-1]
    chance = evaluate(random_policy(env), env, env.goals.training_goals, LONG_SIZES["evaluation_starts"]).success.mean()
    assert 2 * chance < success > 0.7


@pytest.mark.long
def test_the_agents_loss_finds_the_quantiles_of_the_reward(own_agent):
    """Of one state whose action ends the episode with a reward that is uniform in [0, 1]: 1/16, 3/16, ..., 15/16."""
    env = hand_made.environment()
    agent = own_agent["make"](own_agent["QRDQNConfig"](hidden=(16,), num_quantiles=QUANTILES), env)
    hyper = own_agent["QRDQNHyperparameters"](threshold=0.01)
    params, state = agent.init(jax.random.key(0), jnp.ones(2), jnp.ones(3))
    size, optimizer = 256, optax.adam(optax.linear_schedule(0.02, 0.0, 1000))
    features, code, mask = jnp.ones((size, 2)), jnp.ones((size, 3)), jnp.ones((size, env.action_size), bool)

    def step(carry, key):
        params, moments = carry
        batch = AgentBatch(
            observation=None,
            next_observation=None,
            features=features,
            code=code,
            action=jnp.zeros(size, jnp.int32),
            next_features=features,
            next_code=code,
            target_features=features,
            target_code=code,
            reward=jax.random.uniform(key, (size,)),
            discount=jnp.zeros(size),
            action_mask=mask,
            next_action_mask=mask,
        )
        gradient, metrics = jax.grad(agent.loss, has_aux=True)(params, params, batch, state, hyper, key)
        change, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(params, change), moments), metrics

    keys = jax.random.split(jax.random.key(1), 1000)
    (_, _), metrics = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))((params, optimizer.init(params)))
    expected = (np.arange(QUANTILES) + 0.5) / QUANTILES
    assert metrics["spread"][-1] == pytest.approx(expected.std(), abs=0.03)
    assert metrics["value"][-1] == pytest.approx(0.5, abs=0.03)


@pytest.mark.long
def test_settings_of_the_agent_that_make_no_sense_are_refused(own_agent):
    with pytest.raises(infogoal_jax.UserError, match="agent.num_steps"):
        hand_made.config("infogoal", agent=own_agent["QRDQNConfig"](num_steps=21))


@pytest.mark.long
def test_the_task_is_learned():
    """Every line of the page is run; goals that were never desired in training are reached three times as often as by a
    random policy. How often depends on the seed."""
    with run(block_of(TASK), name_of_module="__main__") as names:
        metrics, env = names["result"].metrics, names["train"].env
    held_out = env.goals.evaluated[env.goals.uses == 2]
    chance = evaluate(random_policy(env), env, held_out, 10).success.mean()
    assert metrics["train_goal/success_rate"][-1] > 0.8 and metrics["test_goal/success_rate"][-1] > 3 * chance > 0


def test_every_command_knows_the_task_and_its_defaults():
    """The configuration of the page has the radius that it gives, and the rest by default."""
    with run(block_of(TASK)):
        config = presets.load("two_rooms", "infogoal")
        env = envs.load("two_rooms", dataclasses.replace(config.env, radius=0.3))
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
            main(["train", "two_rooms", "--help-all"])
    assert (config.env.radius, config.env.episode_length, env.radius) == (0.15, 50, 0.3)
    assert "--env.radius" in printed.getvalue() and "Distance below which" in printed.getvalue()


def test_nobody_walks_through_the_wall_of_the_two_rooms():
    with run(block_of(TASK)):
        env = envs.load("two_rooms")
    places = jax.random.uniform(jax.random.key(0), (2000, 2), jnp.float32, 0.0, 2.0)
    actions = jax.random.uniform(jax.random.key(1), (2000, 2), jnp.float32, -1.0, 1.0)
    moved = np.asarray(jax.jit(jax.vmap(env.move))(places, actions))
    crossed = (np.asarray(places)[:, 0] < 1) != (moved[:, 0] < 1)
    assert crossed.any() and (np.abs(np.asarray(places)[crossed, 1] - 1) < 0.25).all()


@pytest.fixture(scope="module")
def own_task() -> dict:
    """The names that the task of the notebook leaves behind."""
    cells = code_cells(read("your_own"))
    with run("\n".join(cells[name].source for name in ("imports", "task"))) as names:
        yield names | {"env": envs.load("walled_square")}


def test_the_task_keeps_the_contract(own_task):
    """What is not written has the default that most tasks need."""
    env = own_task["env"]
    assert isinstance(env, Environment) and env.discrete and env.recorded is None and not env.has_target_states
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 50))
    desired_goal = state.desired_goal
    assert not np.any(env.reached(env.achieved(state), desired_goal)) and np.all(env.goals.train_mask[desired_goal])
    assert (
        env.action_mask(env.observe(state)).shape == (50, 4)
        and env.action_mask(env.observe(state)).all()
        and env.decides(state).all()
    )


def test_the_door_is_the_only_way(own_task):
    """Every cell can be reached from every other through the door, and only through it."""
    env = own_task["env"]
    near = np.eye(64, dtype=bool)
    for _ in range(64):
        near |= near[:, np.asarray(env.next_cell)].any(-1)
    assert near.all()
    crossings = [
        (cell, following)
        for cell, row in enumerate(np.asarray(env.next_cell))
        for following in row
        if cell // 32 != following // 32
    ]
    assert sorted(map(tuple, np.asarray(crossings).tolist())) == [(25, 33), (33, 25)]


def test_all_actions_can_be_taken_after_vectors_too(own_task):
    """The contract's default tells the axes of a batch from those of an observation."""
    env = own_task["env"]

    class SeenAsVectors(own_task["WalledSquare"]):
        observe = lambda self, state: jnp.zeros(3)  # noqa: E731

    assert SeenAsVectors(env.next_cell, env.goals, env.episode_length).action_mask(jnp.zeros((5, 2, 3))).shape == (
        5,
        2,
        4,
    )


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Brax System")  # brax recommends MJX.
@pytest.mark.filterwarnings("ignore:Accessing `ncon`")  # brax reads a field of MJX by its old place.
def test_the_arm_of_brax_is_trained_on():
    """Its tip is at its goal where it says so, and what it sees does not tell the goal."""
    sizes = SMALL | {"num_epochs": 2, "epochs_per_evaluation": 2, "updates_per_epoch": 5}
    with run(block_of(ROBOT)) as names:
        train = infogoal_jax.make_train(presets.load("tip", "none", **sizes))
        result = jax.jit(train)(jax.random.key(0), train.config.hyper, train.env)
        task = names["task"]
        states = [jax.jit(task.reset_to)(jax.random.key(1), jnp.array(goal)) for goal in ([0.1, 0.1], [-0.1, 0.0])]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((result.params, result.metrics)))
    assert np.array_equal(*(task.observe(state) for state in states)) and len(task.shown) == 6
    assert np.linalg.norm(task.achieved(states[0])) == pytest.approx(0.21, abs=0.01)  # It begins stretched out.


class Plane:
    """A point that goes where the action says, for five steps, as OGBench's environments are played."""

    def reset(self, options):
        assert options == {"task_id": 1}
        self.place, self.steps = np.zeros(2), 0
        return self.place, {"goal": np.ones(2)}

    def step(self, action):
        assert action.shape == (2,) and (np.abs(action) <= 1).all()
        self.place, self.steps = self.place + action, self.steps + 1
        return self.place, 0.0, False, self.steps == 5, {"success": 0.0}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of Gymnasium, about OGBench's spaces.
def test_a_policy_that_learned_from_a_file_plays_in_ogbench(tmp_path, monkeypatch, capsys):
    """In its own environment where it is installed."""
    played = []
    if importlib.util.find_spec("ogbench") is None:
        made = types.SimpleNamespace(make_env_and_datasets=lambda name, env_only: played.append(Plane()) or played[0])
        monkeypatch.setitem(sys.modules, "ogbench", made)
    monkeypatch.chdir(tmp_path)
    generator = np.random.default_rng(0)
    walks = {"observations": generator.normal(size=(40, 2)), "actions": generator.uniform(-1, 1, (40, 2))}
    np.savez("walks.npz", **walks, terminals=np.arange(40) % 20 == 19)
    sizes = SMALL | {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": 2, "batch_size": 8}
    load = presets.load

    def prepare(patch):
        patch.setattr(presets, "load", lambda *words, **changes: load(*words, **(changes | sizes)))

    with run(block_of(OGBENCH), prepare=prepare) as names:
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(names["params"]))
    assert all(env.steps == 5 for env in played) and capsys.readouterr().out.strip()


def read(name: str):
    """A notebook as it is in the repository."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    return notebook


def code_cells(notebook) -> dict:
    """The cells with code, by their names."""
    return {cell.id: cell for cell in notebook.cells if cell.cell_type == "code"}


def pictures(cell) -> list[str]:
    """The pictures that a cell shows, in base64."""
    data = [output.data for output in cell.outputs if "data" in output]
    return [one[kind] for one in data for kind in PICTURES if kind in one]


def printed(notebook) -> str:
    """What all cells print."""
    return "".join(output.text for cell in code_cells(notebook).values() for output in cell.outputs if "text" in output)


def test_every_notebook_is_tested():
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == set(DRAWS)


@each_notebook
def test_saved_as_it_ran_with_its_pictures(name):
    """From top to bottom in one session, at full size, without warnings or anybody's paths; small enough for git."""
    notebook = read(name)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells.values()] == list(range(1, len(cells) + 1))
    assert [cell for cell, own in cells.items() if pictures(own)] == list(DRAWS[name])
    assert (ROOT / "notebooks" / f"{name}.ipynb").stat().st_size < LARGEST
    assert not [output for cell in cells.values() for output in cell.outputs if output.get("name") == "stderr"]
    assert not re.search(r"/home/|/root/|/tmp/|/work/|Warning", printed(notebook))


@each_notebook
def test_begins_by_installing_and_says_what_it_is_sized_for(name):
    notebook = read(name)
    title, install = notebook.cells[:2]
    assert "Sized for two CPU cores" in title.source and "GPU" in title.source
    # Quoted, since a requirement may have spaces; what pip could not install is no success.
    assert '%pip install --quiet "{SOURCE}"' in install.source and "RESTART" in install.source
    assert "raise RuntimeError" in install.source
    assert install.source == read("quickstart").cells[1].source


def test_the_learner_is_that_of_the_docs():
    lines = [line.rstrip() for line in block_of(LEARNER).splitlines()]
    assert set(code_cells(read("your_own"))["learner"].source.splitlines()) <= set(lines)


def test_the_robot_is_that_of_the_docs():
    assert code_cells(read("your_robot"))["robot"].source.splitlines() == block_of(ROBOT).strip().splitlines()


@pytest.mark.long
@pytest.mark.parametrize("name", DRAWS)
def test_runs_without_error_or_warning_and_draws_its_figures(name, monkeypatch, tmp_path):
    folders = ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR")
    for folder in folders:  # The user's own Jupyter is left alone.
        monkeypatch.setenv(folder, str(tmp_path / folder))
    monkeypatch.setenv("INFOGOAL_TOY", "1")
    # Nothing is learned at this size: compiling would be most of the time.
    monkeypatch.setenv("XLA_FLAGS", flags(QUICKEST))
    tool = runpy.run_path(str(ROOT / "tools" / "notebooks.py"))
    notebook = tool["execute"](ROOT / "notebooks" / f"{name}.ipynb")
    assert "Warning" not in printed(notebook)
    tool["tidy"](notebook)
    streams = [[output.get("name") for output in cell.outputs] for cell in code_cells(notebook).values()]
    assert all("stderr" not in names and names.count("stdout") < 2 + names.count(None) for names in streams)
    for cell in DRAWS[name]:
        shown = pictures(code_cells(notebook)[cell])
        assert len(shown) == 1 and len(base64.b64decode(shown[0])) > 3000, cell

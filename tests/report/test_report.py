"""What a run reports: tables that leave out and name diverged seeds, and figures that show something."""

import dataclasses
import io
import json
import math
import re
import shutil
import zipfile
from pathlib import Path

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from places import EVERY_TASKS_FIGURES, assert_drawn, printed
from rich.console import Console

from infogoal_jax import UserError, envs, load_run, rollout
from infogoal_jax.cli.main import main
from infogoal_jax.data import archives
from infogoal_jax.loading import make_train
from infogoal_jax.report import task_figures
from infogoal_jax.report.codes import principal_components, representations
from infogoal_jax.report.figures import beta_and_accuracy, draw_figures, read_subject, success_within
from infogoal_jax.report.runs import diverged_seeds, read_params, table_of
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.report.summary import evaluate_run, print_run
from infogoal_jax.runner import training
from infogoal_jax.runs.folder import pack, shipped
from infogoal_paper import house_figures, walks

SEEDS = [3, 4, 5]
FIGURES = EVERY_TASKS_FIGURES | {"trajectories", "intrinsic_reward"}


@pytest.fixture(scope="module")
def env():
    return hand_made.environment_from_above()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory, env):
    """A run without an update."""
    with pytest.MonkeyPatch.context() as patch:
        hand_made.leave_out_updates(patch)
        return training.run(hand_made.config(), SEEDS, tmp_path_factory.mktemp("report") / "run", env=env)


@pytest.fixture
def diverged_run(sweep, tmp_path):
    """A copy of the run in which seed 4 diverged at epoch 3."""
    folder = tmp_path / "run"
    shutil.copytree(sweep.folder, folder)
    rows = [json.loads(line) for line in (folder / "epochs.jsonl").read_text().splitlines()]
    for row in rows:
        if row["seed"] == 4 and row["epoch"] >= 3:
            row["agent/loss"] = math.nan
    (folder / "epochs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_summary_names_data_seeds_and_times(sweep):
    text = printed(print_run, sweep.folder)
    scores = table_of(sweep.folder, "evaluations").last()
    for word in (
        "hand-made graph",
        "3 seeds",
        "compiling",
        "running",
        "beta",
        str(sweep.folder),
        mean_interval(scores["test_goal/spl"]).show(),
    ):
        assert word in text
    assert "diverged" not in text


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_summary_is_broken_between_words_alone(width, sweep):
    """On a terminal of any width no line is longer, and every word is one of a wide terminal's."""
    narrow, wide = (
        Console(file=io.StringIO(), width=size, force_terminal=True, no_color=True) for size in (width, 400)
    )
    for console in (narrow, wide):
        print_run(sweep.folder, console)
    lines, words = (re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue()) for console in (narrow, wide))
    found, whole = ({word for word in text.split() if "─" not in word} for text in (lines, words))
    assert found == whole
    assert "…" not in lines
    assert all(len(line.rstrip()) <= width for line in lines.splitlines() if str(sweep.folder) not in line)


def test_diverged_seed_is_named_and_left_out(sweep, diverged_run, env):
    everything, left = (
        table_of(sweep.folder, "evaluations"),
        table_of(diverged_run, "evaluations", diverged_seeds(diverged_run)),
    )
    assert diverged_seeds(diverged_run) == {4: 3}
    assert left.seeds == [3, 5]
    name = "train_goal/episode_length"
    np.testing.assert_array_equal(left.values[name], everything.values[name][[0, 2]])
    text = printed(print_run, diverged_run)
    assert "seed 4 diverged at epoch 3" in text and "2 seeds" in text
    assert mean_interval(left.last()[name]).show(1) in text
    given = np.int64(2), np.int64(1), np.float32(-1)  # Numbers of NumPy, which JSON does not know, are taken too.
    scores = evaluate_run(diverged_run, *given, env=env, console=Console(file=io.StringIO()))
    assert all(value.shape == (2,) for value in scores.values())


def test_run_whose_seeds_all_diverged_still_reports(diverged_run, env):
    rows = [
        json.loads(line) | {"agent/loss": math.inf} for line in (diverged_run / "epochs.jsonl").read_text().splitlines()
    ]
    (diverged_run / "epochs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    text = printed(print_run, diverged_run)
    quiet = Console(file=io.StringIO())
    evaluate_run(diverged_run, 1, 1, 0.0, env=env, console=quiet)
    assert "no seed is left" in quiet.file.getvalue()
    assert "every seed diverged" in text and all(f"seed {seed} diverged at epoch 1" in text for seed in SEEDS)
    assert draw_figures(diverged_run, env=env) == []


@pytest.mark.long
def test_evaluation_again_depends_on_its_seed_alone(sweep, env):
    quiet = Console(file=io.StringIO())
    first, again, other = (evaluate_run(sweep.folder, 4, seed, 0.5, env=env, console=quiet) for seed in (1, 1, 2))
    assert {
        "train_goal/spl",
        "train_goal_mean_code/spl",
        "test_goal/success_rate",
        "test_goal_mean_code/episode_length",
    } <= first.keys()
    assert all((first[name] == again[name]).all() for name in first)
    assert any((first[name] != other[name]).any() for name in first)
    written = json.loads((sweep.folder / "evaluation.json").read_text())
    assert (written["starts"], written["start_seed"], written["test_epsilon"], written["seeds"]) == (4, 2, 0.5, SEEDS)
    assert written["metrics"]["test_goal/spl"] == pytest.approx(other["test_goal/spl"].tolist())


def test_evaluation_refuses_what_makes_no_sense(sweep, env):
    for starts, seed, epsilon, field in (
        (0, 1, 0.0, "starts"),
        (5, -1, 0.0, "start_seed"),
        (5, 1, 1.5, "test_epsilon"),
    ):
        with pytest.raises(UserError, match=field):
            evaluate_run(sweep.folder, starts, seed, epsilon, env=env)
    with pytest.raises(UserError, match="goals of object_search are not images"):
        evaluate_run(sweep.folder, 5, 1, 0.0, 0.4, env=env)


@pytest.fixture
def rooms_for_a_house(env, monkeypatch):
    """The registered task is the hand-made one, as where a user has put a task of the same name in its place."""
    entry = envs.registry["object_search"]._replace(make=lambda config: env)
    monkeypatch.setitem(envs.registry, "object_search", entry)


def test_a_run_gives_its_policy_and_an_episode(sweep, rooms_for_a_house):
    """The same key gives the same episode; seeds of the run act differently."""
    run = load_run(sweep.folder)
    goal = int(np.asarray(run.env.goals.evaluated)[-1])
    play = jax.jit(lambda env, key: [rollout(env, run.policy(seed), goal, key) for seed in run.seeds])
    first, *others = play(run.env, jax.random.key(0))
    assert first.observations.shape == (run.env.episode_length + 1,) and 0 < first.steps <= run.env.episode_length
    np.testing.assert_array_equal(first.observations, play(run.env, jax.random.key(0))[0].observations)
    assert not all(np.array_equal(first.observations, other.observations) for other in others)


def test_a_seed_that_was_not_trained_is_named(sweep, rooms_for_a_house):
    with pytest.raises(UserError, match="seed = 7: the run has the seeds 3, 4, 5"):
        load_run(str(sweep.folder)).policy(seed=7)


@pytest.mark.long
def test_every_figure_is_drawn_and_shows_something(sweep, env):
    assert_drawn(draw_figures(sweep.folder, env=env), sweep.folder, FIGURES)


def test_a_task_of_ones_own_brings_its_figures_in_place_of_those_of_a_name(sweep, env, monkeypatch):
    subject, mine = read_subject(sweep.folder, env), Figure()
    monkeypatch.setitem(task_figures.registry, subject.run.config.task, lambda seen: {"mine": mine, "none": None})
    assert task_figures.draw_of_task(subject) == {"mine": mine, "none": None}
    nobodys = dataclasses.replace(subject.run, config=dataclasses.replace(subject.run.config, task="nobodys"))
    assert task_figures.draw_of_task(dataclasses.replace(subject, run=nobodys)) == {}


def test_house_without_positions_has_no_plans(sweep, env):
    unknown = read_subject(sweep.folder, env.replace(position=jnp.full_like(env.position, jnp.nan)))
    assert house_figures.draw_plans(unknown) == {}


def test_plan_knows_places_and_the_length_of_a_move(env):
    plan = house_figures.make_plan(env)
    assert len(np.unique(plan.place)) == 1 + hand_made.ROOMS * hand_made.DEPTH and len(np.unique(plan.part)) == 1
    assert all(len(set(plan.place[4 * place : 4 * place + 4])) == 1 for place in range(13))
    assert plan.spacing == pytest.approx(0.6)


def test_intrinsic_reward_is_highest_where_the_goal_itself_is_in_view(sweep, env):
    subject = read_subject(sweep.folder, env)
    (reward,), in_view = walks.rewards_of_images(subject, [0]), np.asarray(env.in_view)
    np.testing.assert_array_equal(np.isnan(reward), ~in_view.any(1))
    assert np.nanmean(reward) == pytest.approx(-1)
    np.testing.assert_allclose(reward[in_view[:, 0]], 0, atol=1e-6)


def test_a_reward_that_does_not_go_by_the_image_has_no_figure(sweep, env):
    """InfoBot's goes by visits, or by what its episode saw first: the parameters know of neither."""
    subject = read_subject(sweep.folder, env)
    parts = subject.train.parts
    learner = parts.learner._replace(intrinsic_reward=lambda state, encode, seen: (seen.mask + seen.first_seen, state))
    train = dataclasses.replace(subject.train, parts=parts._replace(learner=learner))
    subject, plan = dataclasses.replace(subject, train=train), house_figures.make_plan(env)
    assert house_figures.intrinsic_reward(subject, plan, {}) is None


def test_walks_are_those_of_the_last_evaluation(sweep, env):
    subject = read_subject(sweep.folder, env)
    first_reached = subject.evaluations.last()["first_reached"][0]
    found = walks.walks_of_policy(subject)
    steps = [
        [len(walk.nodes) - 1 if walk.success else env.episode_length + 1 for walk in of_goal]
        for of_goal in found.values()
    ]
    np.testing.assert_array_equal(steps, first_reached)


def test_success_by_length_ends_at_the_success_rate(sweep, env):
    scores = table_of(sweep.folder, "evaluations").last()
    curve = success_within(scores["first_reached"], np.asarray(env.goals.test_mask), env.episode_length)
    assert curve.shape == (len(SEEDS), env.episode_length + 1)
    np.testing.assert_allclose(curve[:, -1], scores["test_goal/success_rate"], atol=1e-6)
    assert (np.diff(curve, axis=1) >= 0).all() and (curve[:, 0] == 0).all()


def test_principal_components_find_the_plane_of_the_points():
    plane = np.linalg.qr(np.random.default_rng(2).normal(size=(6, 2)))[0].T
    coordinates = np.random.default_rng(3).normal(size=(20, 2)) * [5, 1]
    centre, axes, shares = principal_components(3.0 + coordinates @ plane)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(
        ((3.0 + coordinates @ plane) - centre) @ axes.T @ axes + centre, 3.0 + coordinates @ plane, atol=1e-12
    )
    assert shares.sum() == pytest.approx(1) and shares[0] > shares[1]


def test_codes_of_one_number_lie_on_a_line_of_the_plane():
    """As those of LEO, whose codes are the numbers of goals: the figure of its codes was a traceback."""
    centre, axes, shares = principal_components(np.array([[1.0], [2.0], [6.0]]))
    np.testing.assert_allclose(np.abs((np.array([[6.0]]) - centre) @ axes.T), [[3.0, 0.0]])
    assert shares.tolist() == [1.0, 0.0]


@pytest.fixture
def packed(sweep, tmp_path, monkeypatch):
    """Seed 4 of the run as one file, with a cache of its own."""
    monkeypatch.setattr(archives, "user_cache", lambda: tmp_path / "cache")
    assert main(["pack", str(sweep.folder), "--out", str(tmp_path / "four.zip"), "--seed", "4"]) == 0
    return tmp_path / "four.zip"


@pytest.mark.long
def test_a_packed_run_is_a_run_of_one_seed(sweep, env, packed, tmp_path):
    """The same parameters and numbers, and figures; small, and the same file whenever it is written."""
    run, whole = load_run(packed), load_run(sweep.folder)
    assert (run.seeds, run.config, run.data) == ([4], whole.config, whole.data)
    params = (read_params(one, sweep.train) for one in (run, whole))
    jax.tree.map(lambda own, all_seeds: np.testing.assert_array_equal(own[0], all_seeds[1]), *params)
    last = [table_of(one.folder, "evaluations").last()["first_reached"] for one in (run, whole)]
    np.testing.assert_array_equal(last[0][0], last[1][1])
    assert "1 seed" in printed(print_run, packed)
    drawn = draw_figures(packed, env)
    assert {path.stem for path in drawn} == FIGURES and drawn[0].parent.parent == run.folder
    pack(sweep.folder, tmp_path / "again.zip", np.int64(4))
    assert (tmp_path / "again.zip").read_bytes() == packed.read_bytes()
    assert packed.stat().st_size < (sweep.folder / "policy").stat().st_size
    assert load_run(packed).folder == run.folder and not list(run.folder.parent.glob(".*"))


def test_what_is_no_packed_run_is_refused(sweep, diverged_run, packed, tmp_path, capsys):
    with pytest.raises(UserError, match="seed = 9: the run has the seeds 3, 4, 5"):
        pack(sweep.folder, tmp_path / "nine.zip", 9)
    with pytest.raises(UserError, match="seed = 4: diverged in training: give another one"):
        pack(diverged_run, tmp_path / "diverged.zip", 4)
    with pytest.raises(UserError, match=r"out = .* ends in \.zip"):
        pack(sweep.folder, tmp_path / "four.tar", 4)
    (tmp_path / "damaged.zip").write_bytes(packed.read_bytes()[:-100])
    with pytest.raises(UserError, match=r"damaged.zip': it is damaged"):
        load_run(tmp_path / "damaged.zip")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as other:
        other.writestr("../outside", "no")
    with pytest.raises(UserError, match="other.zip.*is no file of"):
        load_run(tmp_path / "other.zip")
    foreign = (tmp_path / "other.zip").read_bytes()
    with pytest.raises(UserError, match="is there already and is no packed run"):
        pack(sweep.folder, tmp_path / "other.zip", 4)
    assert (tmp_path / "other.zip").read_bytes() == foreign
    assert not (tmp_path / "outside").exists()
    for damage in ("middle", "encrypted", "lzma"):
        with zipfile.ZipFile(packed) as whole, zipfile.ZipFile(tmp_path / f"{damage}.zip", "w") as other:
            for name in whole.namelist():
                other.writestr(name, whole.read(name), zipfile.ZIP_LZMA if damage == "lzma" else zipfile.ZIP_DEFLATED)
        content = bytearray((tmp_path / f"{damage}.zip").read_bytes())
        if damage == "middle":
            content[len(content) // 2 : len(content) // 2 + 64] = bytes(64)
        if damage == "encrypted":  # The flag of the first member, there and in the directory.
            content[6] |= 1
            content[content.rindex(b"PK\x01\x02", 0, content.index(b"PK\x01\x02") + 4) + 8] |= 1
        (tmp_path / f"{damage}.zip").write_bytes(content)
        with pytest.raises(UserError, match=f"{damage}.zip': it is (damaged|no zip of `infogoal pack`)"):
            load_run(tmp_path / f"{damage}.zip")
    before = {path.name for path in (archives.user_cache() / "runs").glob("*")}
    for damage, message in {
        "config.json": (b"{", "damaged_inside.zip': config.json: is damaged"),
        "policy": (None, "damaged_inside.zip': policy: is damaged.*checksum"),
        "evaluations.jsonl": (b"junk\n", "damaged_inside.zip': evaluations.jsonl, line 1: is damaged"),
    }.items():
        content, words = message
        with zipfile.ZipFile(packed) as whole, zipfile.ZipFile(tmp_path / "damaged_inside.zip", "w") as other:
            for name in whole.namelist():
                own = whole.read(name) if name != damage else whole.read(name)[:-1] if content is None else content
                other.writestr(name, own, zipfile.ZIP_DEFLATED)
        with pytest.raises(UserError, match=words):
            load_run(tmp_path / "damaged_inside.zip")
    assert {path.name for path in (archives.user_cache() / "runs").glob("*")} == before  # Nothing damaged stays.
    assert main(["evaluate", "shipped/object_serch"]) == 2
    assert "Did you mean 'shipped/object_search'" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("name", shipped())
def test_shipped_policies_reach_most_training_goals(name):
    """They are evaluated without training, with starts that training did not see."""
    scores = evaluate_run(Path(name), 5, 7, -1.0)
    assert scores["train_goal/success_rate"].shape == (1,) and scores["train_goal/success_rate"][0] > 0.7


def test_method_without_beta_and_intrinsic_reward_has_no_such_figures(sweep, env):
    config, subject = hand_made.config("none"), read_subject(sweep.folder, env)
    train = make_train(config, env)
    params = {"goal": train.parts.learner.init(jax.random.key(0), hand_made.example(env.goals.inputs), config.hyper)[0]}
    subject = dataclasses.replace(
        subject, run=dataclasses.replace(subject.run, config=config), train=train, params=params
    )
    assert beta_and_accuracy(subject) is None
    assert house_figures.intrinsic_reward(subject, house_figures.make_plan(env), {}) is None
    assert representations(subject).axes[0].get_aspect() == 1  # An axis of little variance looks like one.

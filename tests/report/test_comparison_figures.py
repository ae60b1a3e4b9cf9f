"""Several runs in one figure: each curve is that of its run's tables, and what cannot be compared is refused; and the
intervals over seeds that are drawn: Student's t, at each point of a curve, and of paired differences."""

import dataclasses
import json
import math

import hand_made
import numpy as np
import pytest
from matplotlib.image import imread
from scipy import stats

from infogoal_jax import UserError, envs, presets
from infogoal_jax.agents.cql import CQLConfig
from infogoal_jax.cli.main import main
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.report import canvas
from infogoal_jax.report.comparison_figures import (
    check_metric,
    check_same_task,
    comparison,
    draw_comparison,
    metrics_while_training,
    read_compared,
    titles_of,
)
from infogoal_jax.report.runs import load_run
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.sweeps import SweepResult, draw_sweep
from infogoal_jax.runner.jobs import Plan
from infogoal_jax.runs import tables
from infogoal_jax.runs.configuration import to_dict

EPOCHS, STARTS = (1, 2, 3), 2
DATA = "hand-made graph (a stand-in for nothing)"


@pytest.fixture(scope="module")
def env():
    return hand_made.environment()


def write_run(folder, env, config, seeds=(0, 1, 2), diverged=()):
    """A run's folder as training leaves it, with random results; the success rates are those of the steps that were
    needed."""
    folder.mkdir()
    (folder / "config.json").write_text(
        json.dumps({"config": to_dict(config), "seeds": list(seeds), "data": DATA, "versions": {}, "device": "cpu"})
    )
    random, evaluations, epochs = np.random.default_rng(len(str(folder))), [], []
    for seed in seeds:
        for epoch in EPOCHS:
            first = random.integers(1, 2 * env.episode_length, (len(env.goals.evaluated), STARTS)).clip(
                max=env.episode_length + 1
            )
            rates = {
                f"{group}_goal/success_rate": float(
                    (first[np.asarray(getattr(env.goals, f"{group}_mask"))] <= env.episode_length).mean()
                )
                for group in env.goals.groups
            }
            evaluations.append(
                {"seed": seed, "epoch": epoch, "env_steps": 320 * epoch, "first_reached": first.tolist()} | rates
            )
            epochs.append(
                {
                    "seed": seed,
                    "epoch": epoch,
                    "env_steps": 320 * epoch,
                    f"{presets.name_of(config)}/beta": random.random(),
                    "agent/loss": math.nan if seed in diverged else 0.1,
                    "agent/gradient_norm": 1.0,
                }
            )
    tables.append_rows(folder, "evaluations", evaluations)
    tables.append_rows(folder, "epochs", epochs)
    return folder


@pytest.fixture
def folders(tmp_path, env):
    """A run of InfoGoal, and one of the bare agent with an explorer of which one seed diverged."""
    explored = hand_made.config("none", explorer="sse_db")
    return [
        write_run(tmp_path / "first", env, hand_made.config()),
        write_run(tmp_path / "second", env, explored, diverged=(1,)),
    ]


def curves(figure, place: int) -> dict[str, np.ndarray]:
    """The labelled curves of these axes, by their label: x and y."""
    lines = figure.axes[place].get_lines()
    return {line.get_label(): np.asarray(line.get_xydata()).T for line in lines if not line.get_label().startswith("_")}


def text_of(figure) -> str:
    """The line above the figure and the small print below it."""
    return f"{figure.get_suptitle()} {figure.get_supxlabel()}".replace("\n", " ")


def test_curves_are_the_means_of_the_runs_tables(folders, env):
    """Left against environment steps, right by the allowed length; training goals above test goals; without the seed
    that diverged."""
    figure = comparison([read_compared(folder) for folder in folders], env)
    for row, group in enumerate(("train", "test")):
        left, right = curves(figure, 2 * row), curves(figure, 2 * row + 1)
        assert list(left) == list(right) == ["infogoal, 3 seeds", "sse_db, 2 seeds"]
        for label, folder, seeds in (
            ("infogoal, 3 seeds", folders[0], (0, 1, 2)),
            ("sse_db, 2 seeds", folders[1], (0, 2)),
        ):
            rows = [row for row in tables.read_table(folder, "evaluations") if row["seed"] in seeds]
            rates = [
                np.mean([row[f"{group}_goal/success_rate"] for row in rows if row["epoch"] == epoch])
                for epoch in EPOCHS
            ]
            np.testing.assert_allclose(left[label], [[320, 640, 960], rates])
            first = np.array([row["first_reached"] for row in rows if row["epoch"] == EPOCHS[-1]])[
                :, np.asarray(getattr(env.goals, f"{group}_mask"))
            ]
            np.testing.assert_allclose(
                right[label][1], [(first <= length).mean() for length in range(env.episode_length + 1)]
            )
            assert right[label][1][-1] == pytest.approx(rates[-1])
    assert "training goals" in figure.axes[0].get_ylabel() and "test goals" in figure.axes[2].get_ylabel()


def test_figure_names_task_data_and_what_is_left_out(folders, env):
    text = text_of(comparison([read_compared(folder) for folder in folders], env))
    assert text.startswith("object search") and DATA in text and "sse_db: seed 1 diverged at epoch 1" in text


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ([1, 1], "1 seed"),
        ([2], "mean of 2 seeds (no interval below 3 seeds), each seed a thin line"),
        ([5, 5], "mean of 5 seeds with 95 % interval, each seed a thin line"),
        ([5, 2], "mean of 2 to 5 seeds with 95 % interval from 3 seeds on, each seed a thin line"),
        ([4, 5], "mean of 4 to 5 seeds with 95 % interval, each seed a thin line"),
    ],
)
def test_the_small_print_counts_the_seeds_of_every_curve(counts, said):
    """An interval was said of all where the curve of most seeds had one."""
    assert canvas.curves_in_words(counts) == said


def test_bands_end_where_the_metric_does_and_begin_with_three_seeds(folders, env):
    """A success rate is never above 1 nor below 0; two seeds have lines and no band."""
    figure = comparison([read_compared(folder) for folder in folders], env)
    for axes in figure.axes:
        (band,) = axes.collections
        vertical = band.get_paths()[0].vertices[:, 1]
        assert vertical.min() >= 0 and vertical.max() <= 1
        thin = [line for line in axes.get_lines() if line.get_label().startswith("_")]
        assert len(thin) == 3 + 2


def test_any_metric_is_compared_among_the_runs_that_have_it(folders, env, tmp_path):
    compared = [read_compared(folder) for folder in folders]
    figure = metrics_while_training(compared, ("agent/loss", "infogoal/beta", "test_goal/success_rate"), env)
    assert [list(curves(figure, place)) for place in range(3)] == [
        ["infogoal, 3 seeds", "sse_db, 2 seeds"],
        ["infogoal, 3 seeds"],
        ["infogoal, 3 seeds", "sse_db, 2 seeds"],
    ]
    rows = tables.read_table(folders[0], "epochs")
    beta = [np.mean([row["infogoal/beta"] for row in rows if row["epoch"] == epoch]) for epoch in EPOCHS]
    np.testing.assert_allclose(curves(figure, 1)["infogoal, 3 seeds"], [[320, 640, 960], beta])
    assert "sse_db has no infogoal/beta" in text_of(figure)
    with pytest.raises(UserError, match=r"metric = 'infogoal/bta': no run has it. Did you mean 'infogoal/beta'\?"):
        check_metric("infogoal/bta", compared)
    with pytest.raises(UserError, match="first_reached"):
        check_metric("first_reached", compared)


@pytest.mark.parametrize("first", [0, 1])
def test_a_run_that_acts_and_one_that_learns_offline_count_in_updates(first, folders, env):
    """The first run decided for all; and epochs of other numbers of updates stood on one axis."""
    acts = read_compared(folders[0])
    config = presets.load("embodied_qa", updates_per_epoch=7, batch_size=16)
    offline = acts._replace(run=dataclasses.replace(acts.run, config=config), label="offline")
    pair = [acts._replace(label="acts"), offline]
    for figure in (comparison(pair[::-1] if first else pair, env), metrics_while_training(pair, ("agent/loss",), env)):
        assert figure.axes[0].get_xlabel() == "updates"
        found = curves(figure, 0)
        own = acts.run.config.updates_per_epoch
        np.testing.assert_array_equal(found["acts, 3 seeds"][0], np.array(EPOCHS) * own)
        np.testing.assert_array_equal(found["offline, 3 seeds"][0], np.array(EPOCHS) * 7)
    assert own != 7 and comparison([acts], env).axes[0].get_xlabel() == "environment steps"


@pytest.mark.parametrize("ending", [pytest.param("pdf", marks=pytest.mark.long), "svg"])
def test_figures_for_a_paper(ending, folders, env, tmp_path):
    """Letters stay letters, and on request what stands around the panels is a text beside the figure."""
    path = draw_comparison(folders, tmp_path / f"with.{ending}", env)
    bare = draw_comparison(folders, tmp_path / f"bare.{ending}", env, captions=True)
    assert not path.with_suffix(".caption.txt").exists()
    assert bare.with_suffix(".caption.txt").read_text().startswith("object search: success") and DATA in (
        bare.with_suffix(".caption.txt").read_text()
    )
    if ending == "svg":
        assert DATA in path.read_text() and DATA not in bare.read_text() and "test goals" in bare.read_text()
    else:
        assert path.read_bytes().startswith(b"%PDF") and b"/Subtype /Type3" not in path.read_bytes()


def test_a_style_sheet_of_ones_own(folders, env, tmp_path):
    sheet = tmp_path / "mine.mplstyle"
    sheet.write_text("savefig.dpi: 60\n")
    plain, mine = (
        imread(draw_comparison(folders, tmp_path / f"{name}.png", env, style=style)).shape
        for name, style in (("plain", ""), ("mine", str(sheet)))
    )
    assert mine[0] == pytest.approx(plain[0] * 60 / 130, abs=1)
    with pytest.raises(UserError, match="style = 'not_there'"):
        draw_comparison(folders, tmp_path / "c.png", env, style="not_there")


def test_runs_of_one_method_are_told_apart_by_their_folders(folders, env):
    third = write_run(folders[0].parent / "third", env, hand_made.config())
    labels = curves(comparison([read_compared(folder) for folder in (folders[0], third)], env), 0)
    assert list(labels) == ["infogoal (first), 3 seeds", "infogoal (third), 3 seeds"]


@pytest.mark.parametrize(
    ("names", "ends"),
    [
        (["A/run", "B/run"], ["A/run", "B/run"]),
        (["A/x/run", "B/x/run", "C/other"], ["A/x/run", "B/x/run", "other"]),
        (["run", "A/run"], ["here/run", "A/run"]),
        ([".", "A/seed.zip"], ["here", "seed.zip"]),
        (["A/run", "A/run/"], ["run", "run"]),
        (["A/fetch_reach", "shipped/fetch_reach"], ["fetch_reach", "shipped/fetch_reach"]),
    ],
)
def test_as_much_of_the_path_as_tells_runs_apart(names, ends, folders, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    run = load_run(folders[0])
    titles = titles_of([dataclasses.replace(run, name=name) for name in names])
    assert titles == [f"infogoal ({end})" for end in ends]


def test_agents_are_named_where_they_differ(folders):
    run = load_run(folders[0])
    other = dataclasses.replace(run, config=dataclasses.replace(run.config, agent=CQLConfig()))
    assert titles_of([run, other]) == ["dqn, infogoal", "cql, infogoal"]


@pytest.mark.long  # Figures that labels name, and of the command, are drawn below.
def test_figure_is_written(folders, env, tmp_path):
    path = draw_comparison(folders, tmp_path / "figures" / "eight.png", env)
    picture = imread(path)[..., :3]
    assert min(picture.shape[:2]) > 300 and (picture.min(-1) < 0.9).mean() > 0.01


def test_what_cannot_be_compared_is_refused(folders, env, tmp_path):
    """Another task, another setting of the task, a run without numbers, and a file that is no figure, each with the
    folder or the value."""
    first = read_compared(folders[0]).run
    other_task = dataclasses.replace(first, config=presets.load("embodied_qa"))
    with pytest.raises(UserError, match="is of task embodied_qa, and .*first of object_search; give runs of one task"):
        check_same_task([first, other_task])
    longer = dataclasses.replace(first.config, env=dataclasses.replace(first.config.env, episode_length=30))
    with pytest.raises(UserError, match="env.episode_length = 30, and .*first 20"):
        check_same_task([first, dataclasses.replace(first, config=longer)])
    moved = dataclasses.replace(first.config, env=dataclasses.replace(first.config.env, dataset="/b"))
    check_same_task([first, dataclasses.replace(first, config=moved)])
    check_same_task([first, dataclasses.replace(first, data=f"{DATA}; low level, content 12345678")])
    with pytest.raises(UserError, match="run = .*has data = 'another house', and .*first 'hand-made.*on the same data"):
        check_same_task([first, dataclasses.replace(first, config=moved, data="another house")])
    begun = write_run(tmp_path / "begun", env, hand_made.config())
    (begun / "evaluations.jsonl").write_text("")
    with pytest.raises(UserError, match="begun': has no evaluation yet; leave it out"):
        draw_comparison([folders[0], begun], tmp_path / "a.png", env)
    all_diverged = write_run(tmp_path / "diverged", env, hand_made.config(), diverged=(0, 1, 2))
    with pytest.raises(UserError, match="runs = .*every seed of each diverged"):
        draw_comparison([all_diverged, all_diverged], tmp_path / "a.png", env)
    with pytest.raises(UserError, match="out = .*ends in .png, .pdf, .svg"):
        draw_comparison(folders, tmp_path / "a.jpg", env)
    assert not (tmp_path / "a.png").exists()


def test_a_run_that_diverged_whole_is_named_and_left_out(folders, env, tmp_path):
    """It refused the figure of all others, a sweep's at its end."""
    lost = write_run(tmp_path / "lost", env, hand_made.config(), diverged=(0, 1, 2))
    compared = [read_compared(folder) for folder in (lost, *folders)]
    for figure in (comparison(compared, env), metrics_while_training(compared, ("agent/loss", "infogoal/beta"), env)):
        assert "infogoal (lost): every seed diverged, and it is left out" in text_of(figure)
        assert "mean of 2 to 3 seeds" in text_of(figure) and "(lost) has no" not in text_of(figure)
        assert list(curves(figure, 0)) == ["infogoal (first), 3 seeds", "sse_db, 2 seeds"]


def test_any_number_of_runs_is_drawn_each_in_a_colour_of_its_own(folders, env):
    """And beside the panels, which keep their width, stand all of their names."""
    runs = [read_compared(folders[0])._replace(label=f"learning_rate=0.0001,discount=0.{n}") for n in range(40)]
    for figure in (comparison(runs, env), metrics_while_training(runs, ("agent/loss",), env)):
        figure.draw_without_rendering()
        named = [line for line in figure.axes[0].get_lines() if not line.get_label().startswith("_")]
        assert len({line.get_color() for line in named}) == 40
        (legend,) = figure.legends
        assert len(legend.texts) == 40
        inches = legend.get_window_extent().transformed(figure.dpi_scale_trans.inverted())
        assert inches.y0 > 0 and inches.y1 < figure.get_figheight()
        assert figure.axes[0].get_window_extent().width / figure.dpi > 3


def test_a_sweep_is_drawn_without_the_setting_that_diverged(tiny_house, tmp_path):
    """And where all did, there is no figure, as of a single run."""
    config = presets.load("object_search", env=ObjectSearchConfig(dataset=str(tiny_house)))
    env, plan = envs.load("object_search", config.env), Plan([{"discount": 0.5}, {"discount": 0.9}], [0, 1], 0)
    for name, diverged in zip(plan.names, ((0,), (0, 1)), strict=True):
        write_run(tmp_path / name, env, config, plan.seeds, diverged)
    assert draw_sweep(tmp_path, plan) == [tmp_path / "comparison.png"] and (tmp_path / "comparison.png").exists()
    rows = SweepResult(tmp_path, plan).rows()
    assert [(row["discount"], row["seed"], row["diverged"]) for row in rows] == [
        (0.5, 0, True),
        (0.5, 1, False),
        (0.9, 0, True),
        (0.9, 1, True),
    ]
    plan = Plan(plan.settings[1:], plan.seeds, 0)
    assert draw_sweep(tmp_path, plan) == []


def test_labels_name_the_runs_in_the_legend(folders, env, tmp_path):
    """One for each run, each of its own; on the command line too."""
    labelled = [read_compared(folder)._replace(label=label) for folder, label in zip(folders, "ab", strict=True)]
    assert list(curves(comparison(labelled, env), 0)) == ["a, 3 seeds", "b, 2 seeds"]
    assert list(curves(metrics_while_training(labelled, ("agent/loss",), env), 0)) == ["a, 3 seeds", "b, 2 seeds"]
    assert draw_comparison(folders, tmp_path / "labelled.png", env, labels=("ours", "theirs")).exists()
    with pytest.raises(UserError, match="labels = .*give 2, one for each run"):
        draw_comparison(folders, tmp_path / "c.png", env, labels=("ours",))
    with pytest.raises(UserError, match="labels = .*a label of its own"):
        draw_comparison(folders, tmp_path / "c.png", env, labels=("ours", "ours"))


def test_command(folders, tmp_path, capsys):
    """Mistakes are named without a traceback, and nothing is written."""
    assert main(["compare", str(folders[0]), str(tmp_path / "none"), "--out", str(tmp_path / "a.png")]) == 2
    assert "there is no such folder" in capsys.readouterr().err
    assert main(["compare", "--out", str(tmp_path / "a.png")]) == 2
    assert "give at least one folder of a run" in capsys.readouterr().err


def test_a_shipped_policy_is_called_by_its_name_and_not_by_its_place_in_the_cache(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    names = ["shipped/fetch_reach", "shipped/object_search"]
    assert main(["compare", *names, "--out", str(tmp_path / "a.png")]) == 2
    refusal = "run = 'shipped/object_search': is of task object_search, and shipped/fetch_reach of fetch_reach; give"
    assert refusal in capsys.readouterr().err
    assert titles_of([load_run(names[0]), load_run(names[0])])[0].endswith(" (shipped/fetch_reach)")


def test_command_draws(tiny_house, tmp_path, capsys):
    """A run in a house on disk, which is loaded by its configuration."""
    config = presets.load("object_search", env=ObjectSearchConfig(dataset=str(tiny_house)))
    folder = write_run(tmp_path / "run", envs.load("object_search", config.env), config, seeds=(0,))
    assert main(["compare", str(folder), "--out", str(tmp_path / "a.png")]) == 0
    assert str(tmp_path / "a.png") in capsys.readouterr().out and (tmp_path / "a.png").stat().st_size > 10_000


def test_interval_is_students_t():
    values = [0.2, 0.5, 0.6, 0.9]
    interval = mean_interval(values)
    low, high = stats.t.interval(0.95, 3, loc=np.mean(values), scale=stats.sem(values))
    np.testing.assert_allclose((interval.mean, interval.low, interval.high), (0.55, low, high))
    # By hand: t(0.975, 1) = 12.706, and the standard error of two numbers is half of their difference.
    assert mean_interval([1.0, 3.0]).half_width == pytest.approx(12.7062, abs=1e-4)


def test_interval_is_taken_at_each_point_of_a_curve():
    curves = np.random.default_rng(0).normal(size=(5, 7))
    interval = mean_interval(curves)
    assert interval.mean.shape == interval.half_width.shape == (7,)
    assert interval.half_width[2] == pytest.approx(mean_interval(curves[:, 2]).half_width)


def test_one_seed_has_no_interval_and_none_has_no_mean():
    one, none = mean_interval([0.52]), mean_interval([])
    assert one.mean == 0.52 and math.isnan(one.half_width) and one.show() == "0.52"
    assert math.isnan(none.mean) and none.show() == "-"
    assert mean_interval([0.5, 0.5]).show() == "0.50 ± 0.00"


def test_paired_difference_is_first_minus_second_and_forgets_what_seeds_share():
    luck = np.random.default_rng(1).normal(size=8)
    difference = paired_difference(luck + 0.3 + 0.01 * np.arange(8), luck)
    assert difference.mean == pytest.approx(0.335)
    assert difference.low > 0 > paired_difference(luck, luck + 0.3 + 0.01 * np.arange(8)).high
    assert difference.half_width < mean_interval(luck).half_width / 10
    with pytest.raises(UserError, match="same seeds"):
        paired_difference([1.0, 2.0], [1.0])


def test_letters_that_the_font_does_not_have_are_named_in_one_line(tmp_path, capsys):
    """And other warnings of matplotlib are left as they are."""
    figure = canvas.empty_figure("目标 and 目", ("data",), (4.0, 3.0))
    canvas.save(figure, tmp_path / "a.png")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"infogoal: {tmp_path / 'a.png'}: the font has no 标目, drawn as boxes")
    canvas.save(canvas.empty_figure("goal", ("data",), (4.0, 3.0)), tmp_path / "b.png")
    assert capsys.readouterr().err == ""

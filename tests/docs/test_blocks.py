"""Every block of the README, the first pages and the guides is run: a page is played from top to bottom in a folder of
its own, as a reader types it, with training so short that nothing is learned. What is not run is named here, and why.
"""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import words
from places import ROOT, forgotten

import infogoal_jax.bridges.brax  # noqa: F401  Before brax, which then warns of nothing.
from infogoal_jax import presets
from infogoal_jax.bridges.minari import to_minari
from infogoal_jax.cli.main import main
from infogoal_jax.data.episodes import Episodes, save
from infogoal_jax.envs.adapters import is_there

PAGES = {words.README.name: words.README} | {page.name: page for page in words.pages("start", "guides")}
TOY = {
    "num_epochs": 1,
    "epochs_per_evaluation": 1,
    "num_envs": 8,
    "rollout_steps": 20,
    "buffer_steps": 400,
    "updates_per_epoch": 1,
    "batch_size": 16,
    "evaluation_starts": 1,
}
"""Every preset is that short."""
SMALLER = (
    ("--num-epochs 200", "--num-epochs 2"),
    ("--small --seeds 2", "--small --seeds 2 --num-epochs 1"),
    ("--num-epochs 100", "--num-epochs 2"),
    ("--num-epochs 10", "--num-epochs 1"),
    ("--num-epochs 2 --epochs-per-evaluation 2 --updates-per-epoch 1000", "--num-epochs 1"),
    ("--num-epochs 20 ", "--num-epochs 1 "),
    ("num_epochs=20, epochs_per_evaluation=5", "num_epochs=1"),
    ("num_epochs=20", "num_epochs=1"),
    ("object_search --seeds 16", "object_search --seeds 2"),
    ("fetch_push --seeds 5", "fetch_push --seeds 1"),
    ("--seeds 48 --vmap-size 12", "--seeds 4 --vmap-size 2"),
    ("--trials 16", "--trials 4"),
    ("num_epochs=50, batch_size=128", "num_epochs=2"),
    ("num_timesteps=100_000, episode_length=50, num_envs=128", "num_timesteps=400, episode_length=50, num_envs=4"),
    ("trials=16", "trials=2"),
    ("range(48)", "range(4)"),
    ("--starts 50", "--starts 1"),
    ("starts=10", "starts=1"),
    ("seeds_at_once=12", "seeds_at_once=2"),
)
"""What the pages have at another size."""
OTHERWISE = (
    ("infogoal evaluate RUN --corruption", "infogoal evaluate IMAGES --corruption"),
    ("infogoal evaluate RUN --goal", "infogoal evaluate MAZE --goal"),
    ("runs/object_search-infogoal-20261122-120000", "RUN"),
    (', execute=partial(run_on_ray, address="auto")', ""),
    ("--simulate", "--simulate --speed 4"),
    ("--from docs/results", f"--from {ROOT}/docs/results"),
    ('Path("docs/results")', f'Path("{ROOT}/docs/results")'),
    ("infogoal report FOLDER", "infogoal report runs/*"),
)
"""A run of the task that the page means, no cluster, a drone that is four times as fast, and where the numbers are."""
NOT_RUN = {
    r"^REPOSITORY=|^pip |^git clone |^make ": "sets up what these tests run in; test_package.py installs the wheel",
    r"^srun |scontrol|#SBATCH": "needs Slurm",
    r"nvidia-cuda-mps-control|--gpus ": "needs GPUs; test_settings.py and paper/test_work.py start the processes",
    r"--engine ray": "needs a cluster of Ray; test_executors.py and paper/test_cluster.py start one",
    r"--distributed": "needs several hosts; test_distributed.py starts several processes",
    r"--wandb": "needs an account; test_host.py has a W&B of its own",
    r"^infogoal record|^infogoal fly policy.npz|recordings|mine_embeddings": "needs a drone; tests/drone flies one",
    r"--env.questions mine.json": "needs the reader's questions; data/test_laboratory.py has some",
    r"^drone.md: infogoal data check": "the same; the dataset is what was recorded",
    r"--env.dataset grid.npz": "needs more poses than the page has; data/test_laboratory.py has some",
    r"^minari download": "needs the network; the dataset is made here",
    r"PATH": "needs the Active Vision Dataset; data/test_active_vision.py has one of its form",
    r"^infogoal reproduce goal-images": "needs OpenGL and Gymnasium-Robotics",
    r"^infogoal reproduce (all|table1|all_goals) (--quick|--tasks|--out)": "trains for hours; paper/test_command.py",
    r"^infogoal reproduce (table1 --known|merge|all --from docs/results --out docs/results)": "paper/test_command.py",
}
"""Lines, or lines of a page, and why they are not run here."""
NEEDS = {
    r"gymnasium:Fetch": "gymnasium_robotics",
    r"playground:": "mujoco_playground",
    r"jaxgcrl:": "jaxgcrl",
    r"import-minari|ogbench:walks": "minari",
}
"""Lines that are not run with their page, but where a package is installed."""
STATUS = {"infogoal methods fetch_push her --agent dqn": 1}
"""What a line says by its exit status: this combination does not work."""
MINE = "my_task", "my_learner", "my_agent"
"""Files that a page tells its reader to save a block as."""


def blocks_of(page: Path) -> list[tuple[str, str]]:
    """The language and the text of every block, in the order of the page."""
    return re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.M | re.S)


def lines_of(block: str) -> list[str]:
    """What is typed, without comments."""
    typed = (re.split(r"(?:^|\s+)# ", line)[0].strip() for line in block.splitlines())
    return [line for line in typed if line]


def why_not(page: str, line: str) -> str:
    """Why a line of a page is not run, or nothing."""
    lines = line, f"{page}: {line}"
    reasons = NOT_RUN | {pattern: f"needs {package}; run apart" for pattern, package in NEEDS.items()}
    return next((why for pattern, why in reasons.items() if any(re.search(pattern, line) for line in lines)), "")


def here(text: str) -> str:
    """A text of a page as it is run here."""
    for page, played in SMALLER + OTHERWISE:
        text = text.replace(page, played)
    return text


@pytest.fixture(scope="module")
def toy_presets() -> Iterator[None]:
    """Every preset is of these sizes, unless a page gives its own."""
    load = presets.load

    def small(task, method="infogoal", **changes):
        return load(task, method, **(TOY | changes))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "load", small)
        yield


@pytest.fixture(scope="module")
def toy_runs(toy_presets, tmp_path_factory, reach_run) -> Path:
    """A folder with the runs that pages speak of."""
    folder = tmp_path_factory.mktemp("toy")
    for name, task in (("RUN", "object_search"), ("OTHER_RUN", "object_search --method her"), ("MAZE", "point_maze")):
        assert main(f"train {task} --no-figures --out {folder / name}".split()) == 0
    shutil.copytree(reach_run.folder, folder / "IMAGES")
    return folder


@pytest.fixture
def reader(toy_runs, tmp_path, monkeypatch) -> Iterator[Path]:
    """A reader's folder, with those runs and an exported policy in it, who has downloaded a dataset of OGBench."""
    shutil.copytree(toy_runs, tmp_path, dirs_exist_ok=True)
    downloaded = tmp_path / ".ogbench" / "data" / "pointmaze-medium-navigate-v0.npz"
    downloaded.parent.mkdir(parents=True)
    save(downloaded, walks())
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path


def walks() -> Episodes:
    """Three episodes of 20 observations of a point."""
    seen = np.random.default_rng(0).uniform(-1, 1, (60, 2)).astype(np.float32)
    return Episodes(seen, seen, np.arange(60) % 20 == 19)


def write_photos(table: str, name: str) -> None:
    """The CSV of a page, and a picture for each of its rows."""
    Path("photos").mkdir(exist_ok=True)
    Path(name).write_text(table)
    for number, row in enumerate(table.splitlines()[1:]):
        path = Path("photos", row.split(",")[0])
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((64, 64, 3), 40 * number, np.uint8))


def play_python(block: str, names: dict) -> None:
    """Run a block after those before it. What it registers is forgotten, and lies in the files of the reader."""
    for name in MINE:
        Path(f"{name}.py").write_text(block)
    with forgotten():
        exec(compile(here(block), "page", "exec"), names)


def play_line(line: str) -> None:
    """Run a line of the command."""
    command, *arguments = shlex.split(here(line))
    assert command == "infogoal", line
    arguments = [str(next(Path().glob(word))) if "/*" in word else word for word in arguments]
    with forgotten():
        try:
            status = main(arguments)
        except SystemExit as stopped:  # After a help.
            status = stopped.code
    assert status == STATUS.get(line, 0), line


def test_a_reason_is_there_for_lines_of_pages():
    typed = [
        f"{start}{line}"
        for name, page in PAGES.items()
        for _, block in blocks_of(page)
        for line in lines_of(block)
        for start in ("", f"{name}: ")
    ]
    assert not [pattern for pattern in (*NOT_RUN, *NEEDS) if not any(re.search(pattern, line) for line in typed)]
    text = "".join(page.read_text() for page in PAGES.values())
    assert not [old for old, _ in SMALLER + OTHERWISE if old not in text]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Brax System")  # brax recommends MJX.
@pytest.mark.filterwarnings("ignore:Accessing `ncon`")  # brax reads a field of MJX by its old place.
@pytest.mark.parametrize("page", [name for name, page in PAGES.items() if blocks_of(page)])
def test_what_a_page_says_to_type_runs(page, reader, capsys):
    names, tables = {"__name__": "__main__"}, iter(("photos.csv", "grid.csv"))
    files = [block for kind, block in blocks_of(PAGES[page]) if kind == "text"]
    for table in files:
        write_photos(table, next(tables))
    for kind, block in blocks_of(PAGES[page]):
        if kind == "python":
            play_python(block, names)
        elif kind != "text":
            for line in lines_of(block):
                if not why_not(page, line):
                    play_line(line)
    if page == "README.md":
        assert names["result"].metrics["train_goal/success_rate"].shape == (4, 1)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of packages that ask for others' older versions.
@pytest.mark.parametrize("pattern", NEEDS)
def test_lines_for_another_library_run_where_it_is_installed(pattern, reader, monkeypatch):
    if not is_there(NEEDS[pattern]):
        pytest.skip(f"{NEEDS[pattern]} is not installed")
    if NEEDS[pattern] == "minari":
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(reader / "minari"))
        (reader / "minari/D4RL/pointmaze").mkdir(parents=True)
        to_minari(walks(), reader / "minari/D4RL/pointmaze/umaze-v2")
    consoles = [block for page in PAGES.values() for kind, block in blocks_of(page) if kind == "console"]
    for line in (line for block in consoles for line in lines_of(block)):
        if re.search(pattern, line):
            play_line(line)

"""Conservative Q-learning in PyTorch on the CPU, the peer of offline.py: the same networks, loss and batches, fed by a
DataLoader.

    python benchmarks/peers/offline_peer.py ARRAYS.npz [--updates 200] [--repeats 3] [--batch 256 1024] [--workers 2]
        [--threads 1 2]

offline.py writes ARRAYS.npz and starts this program with `--peer`. It needs torch and numpy alone, and prints one line
of json: updates a second of each way to make batches, and of updates on one batch that is there already. It encodes the
images of every move, as they come out of a DataLoader; training encodes each image of a small dataset once an update,
which comes to the same loss.
"""

import argparse
import copy
import json
import os
import random
import time

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from torch.utils.data import BatchSampler, DataLoader, Dataset, RandomSampler

WARM_UP = 5
"""Updates before the clock starts."""


class Moves(Dataset):
    """The recorded moves. Each is given another goal when it is read: one reached later in its flight, any known one,
    or the flight's own.

    arrays: images uint8 [K, H, W, C]; in_view bool [K, N]; known_goals int [K, G], padded with -1; action_mask bool [K,
    A]; known int [G]; image int [R, T + 1], action int [R, T], goal int [R] and length int [R] of each flight.
    """

    def __init__(self, arrays: dict[str, np.ndarray], settings: dict):
        self.images, self.in_view, self.action_mask = (arrays[name] for name in ("images", "in_view", "action_mask"))
        self.image, self.action, self.goal, self.length = (
            arrays[name] for name in ("image", "action", "goal", "length")
        )
        self.known_goals, self.known, self.settings = arrays["known_goals"], arrays["known"], settings
        self.goals_seen = [goals[goals >= 0].tolist() for goals in self.known_goals]
        self.row = np.repeat(np.arange(len(self.length)), self.length)
        self.step = np.concatenate([np.arange(length) for length in self.length])
        something = (self.known_goals >= 0).any(1)[self.image] & (
            np.arange(self.image.shape[1]) <= self.length[:, None]
        )
        self.something = something  # [R, T + 1], whether a goal is reached there
        self.steps_with_something = [np.flatnonzero(steps).tolist() for steps in something]
        self.random = None

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, index):
        """One move, or a whole batch of them if `index` is a list."""
        if isinstance(index, list):
            return self.batch(np.array(index))
        row, step = self.row[index], self.step[index]
        goal, share = self.goal[row], random.random()
        if share < self.settings["future_share"]:
            later = [other for other in self.steps_with_something[row] if other > step]
            goal = random.choice(self.goals_seen[self.image[row, random.choice(later)]]) if later else goal
        elif share >= 1 - self.settings["random_share"]:
            goal = random.choice(self.known)
        return self.moves(row, step, goal)

    def batch(self, index: np.ndarray):
        """The moves of these indices [B], all at once."""
        if self.random is None:  # One for each worker.
            self.random = np.random.default_rng(torch.initial_seed() % 2**63)
        row, step = self.row[index], self.step[index]
        share = self.random.random(len(index))
        later = self.something[row] & (np.arange(self.image.shape[1]) > step[:, None])
        reached = np.where(later, self.random.random(later.shape), -1).argmax(1)
        seen = self.known_goals[self.image[row, reached]]
        future = np.take_along_axis(
            seen, np.where(seen >= 0, self.random.random(seen.shape), -1).argmax(1)[:, None], 1
        )[:, 0]
        goal = np.where((share < self.settings["future_share"]) & later.any(1), future, self.goal[row])
        goal = np.where(share >= 1 - self.settings["random_share"], self.random.choice(self.known, len(index)), goal)
        return {name: torch.from_numpy(values) for name, values in self.moves(row, step, goal).items()}

    def moves(self, row, step, goal) -> dict:
        """What the loss needs of one move, or of many."""
        here, there = self.image[row, step], self.image[row, step + 1]
        reached = self.in_view[there, goal]
        return {
            "image": self.images[here],
            "next_image": self.images[there],
            "goal": goal,
            "action": self.action[row, step],
            "reward": np.float32(reached),
            "discount": np.float32(self.settings["discount"] * ~reached),
            "action_mask": self.action_mask[here],
            "next_action_mask": self.action_mask[there],
        }


def perceptron(size: int, hidden: list[int], out: int) -> nn.Sequential:
    """ReLU layers of these widths, then a linear one."""
    layers = []
    for width in hidden:
        layers += [nn.Linear(size, width), nn.ReLU()]
        size = width
    return nn.Sequential(*layers, nn.Linear(size, out))


class Values(nn.Module):
    """Q(s, g, a) of images and goals: encoder of patches, encoder of goal vectors, and a head over both."""

    def __init__(self, settings: dict, image_shape: tuple[int, int, int], goal_size: int, num_actions: int):
        super().__init__()
        height, width, channels = image_shape
        self.patch = settings["patch"]
        self.patches = nn.Linear(self.patch**2 * channels, settings["channels"])
        self.whole = nn.Linear(height * width // self.patch**2 * settings["channels"], settings["features"])
        self.norm = nn.LayerNorm(settings["features"], eps=1e-6)
        self.goals = perceptron(goal_size, settings["goal_hidden"], settings["latent_size"])
        self.head = perceptron(settings["features"] + settings["latent_size"], settings["hidden"], num_actions)

    def cut(self, images: torch.Tensor) -> torch.Tensor:
        """Images uint8 [B, H, W, C] as patches float32 [B, H W / side^2, side^2 C]."""
        number, height, width, channels = images.shape
        side = self.patch
        patches = images.reshape(number, height // side, side, width // side, side, channels).transpose(2, 3)
        return patches.reshape(number, -1, side * side * channels).float().div_(127.5).sub_(1)

    def forward(self, patches: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        """Values [B, A] of images cut into patches and of encoded goals [B, d]."""
        features = functional.relu(self.patches(patches))
        features = functional.relu(self.norm(self.whole(features.reshape(len(patches), -1))))
        return self.head(torch.cat([features, goals], -1))


class Agent:
    """Values, their slow copy, and one update of both."""

    def __init__(self, arrays: dict[str, np.ndarray], settings: dict):
        self.settings, self.goal_inputs = settings, torch.from_numpy(arrays["goal_inputs"])
        self.values = Values(
            settings, arrays["images"].shape[1:], self.goal_inputs.shape[1], arrays["action_mask"].shape[1]
        )
        self.target = copy.deepcopy(self.values).requires_grad_(False)
        self.optimizer = torch.optim.Adam(self.values.parameters(), lr=settings["learning_rate"], fused=True)

    def loss(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """Huber loss of double Q-learning, and the conservative term. All goals are encoded once: they are fewer than
        the batch, as offline.py's."""
        goal = batch["goal"].long()
        codes = self.values.goals(self.goal_inputs)[goal]
        every = self.values(self.values.cut(batch["image"]), codes)
        value = every.gather(1, batch["action"].long()[:, None])[:, 0]
        with torch.no_grad():
            following_patches = self.values.cut(batch["next_image"])
            ahead = self.values(following_patches, codes).masked_fill(~batch["next_action_mask"], -torch.inf).argmax(1)
            following = self.target(following_patches, self.target.goals(self.goal_inputs)[goal]).gather(
                1, ahead[:, None]
            )[:, 0]
            aim = batch["reward"] + batch["discount"] * following
        gap = every.masked_fill(~batch["action_mask"], -torch.inf).logsumexp(1) - value
        return functional.huber_loss(value, aim) + self.settings["conservative_weight"] * gap.mean()

    def update(self, batch: dict[str, torch.Tensor]) -> None:
        """One step of Adam, and the slow copy's step after it."""
        self.optimizer.zero_grad()
        self.loss(batch).backward()
        nn.utils.clip_grad_norm_(self.values.parameters(), self.settings["max_gradient_norm"], foreach=True)
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.target.parameters()), list(self.values.parameters()), self.settings["target_rate"]
            )


def loader(moves: Moves, batch: int, updates: int, workers: int, whole: bool) -> DataLoader:
    """Batches of moves drawn with replacement; `whole`: each is read by one call of the dataset, instead of one for
    each move."""
    indices = RandomSampler(moves, replacement=True, num_samples=batch * updates)
    if whole:
        return DataLoader(
            moves, sampler=BatchSampler(indices, batch, drop_last=True), batch_size=None, num_workers=workers
        )
    return DataLoader(moves, sampler=indices, batch_size=batch, num_workers=workers)


def rate(agent: Agent, batches, updates: int) -> float:
    """Updates a second over `updates` of these batches, after the first `WARM_UP`."""
    for number, batch in enumerate(batches):
        if number == WARM_UP:
            started = time.perf_counter()
        agent.update(batch)
        if number + 1 == WARM_UP + updates:
            break
    return updates / (time.perf_counter() - started)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arrays")
    parser.add_argument("--updates", type=int, default=200, help="updates that are timed of each way")
    parser.add_argument("--repeats", type=int, default=3, help="runs of so many updates, of which the fastest counts")
    parser.add_argument("--batch", type=int, nargs="+", default=[256])
    parser.add_argument(
        "--threads", type=int, nargs="+", default=sorted({1, os.cpu_count()}), help="of torch; the faster number counts"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes that read batches")
    arguments = parser.parse_args()
    arrays = dict(np.load(arguments.arrays))
    settings = json.loads(str(arrays.pop("settings")))
    moves, agent, found = Moves(arrays, settings), Agent(arrays, settings), {}
    ways = {
        "moves one by one, worker processes": (arguments.workers, False),
        "moves one by one": (0, False),
        "whole batches, worker processes": (arguments.workers, True),
        "whole batches": (0, True),
    }
    for batch in arguments.batch:
        there = next(iter(loader(moves, batch, 1, 0, whole=True)))
        feeds = {
            name: lambda workers=workers, whole=whole, batch=batch: loader(
                moves, batch, WARM_UP + arguments.updates, workers, whole
            )
            for name, (workers, whole) in ways.items()
        } | {"one batch again and again": lambda there=there: (there for _ in range(WARM_UP + arguments.updates))}
        found[batch] = dict.fromkeys(feeds, 0.0)
        for threads in arguments.threads:
            torch.set_num_threads(threads)
            for name, feed in feeds.items():
                found[batch][name] = max(
                    found[batch][name], *(rate(agent, feed(), arguments.updates) for _ in range(arguments.repeats))
                )
    about = (
        f"torch {torch.__version__}, {' or '.join(map(str, arguments.threads))} threads (the faster), "
        f"{arguments.workers} worker processes"
    )
    print(json.dumps({"about": about, "updates_per_second": found}))


if __name__ == "__main__":
    main()

"""How many bytes one update moves through memory, beside the least that its mathematics needs, and how many kernels.

    python benchmarks/speed/update_bytes.py [--tasks object_search ...] [--method infogoal] [--seeds 16] [--largest 12]
        [--bfloat16]

Counted in the program that the compiler made for this device: what every kernel of the loop over updates reads and
writes; of an array that a kernel takes parts from, those parts. Caches are not known to it, so that an array that two
kernels read one after another counts twice.

The least: images and vectors that the update learns from are read once; parameters, those of the target networks and
both moments are read once and written once; what a product of matrices makes is written once, forwards and backwards,
the gradient among it. Everything else could stay in registers.
"""

import argparse
import math
import re
from typing import NamedTuple

import jax

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.compilation import inner_programs
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.update import sample, update, updates

WIDTHS = {"pred": 1, "bf16": 2, "c64": 8, "c128": 16}
FREE = {"parameter", "get-tuple-element", "tuple", "constant", "bitcast", "after-all", "iota", "partition-id"}
PARTS = {"dynamic-slice", "gather", "slice"}
INSTRUCTION = re.compile(r"^\s*(ROOT )?%?([\w.\-]+) = ((?:\([^=]*?\))|(?:\S+)) ([\w\-]+)\((.*)$")
WORKSPACE = re.compile(r"s8\[\d+\]")
"""What a library's product has beside its result, and hardly touches."""
ARRAY = re.compile(r"(\w+)\[([\d,]*)\]")


class Instruction(NamedTuple):
    """A line of a compiled program."""

    name: str
    shape: str
    """As it is written, with the types of a tuple in brackets."""
    kind: str
    operands: tuple[str, ...]
    line: str

    def called(self, attribute: str) -> str | None:
        """The computation that the attribute names; None without."""
        found = re.search(rf"\b{attribute}=%?([\w.\-]+)", self.line)
        return found and found[1]

    @property
    def place(self) -> str:
        """Where it comes from in the code, as far as the compiler says."""
        found = re.search(r'op_name="([^"]*)"', self.line)
        return found[1] if found else ""


def bytes_of_shape(shape: str) -> int:
    """Bytes of an array, or of all arrays of a tuple."""
    total = 0
    for kind, axes in ARRAY.findall(shape):
        digits = re.search(r"\d+", kind)
        width = WIDTHS.get(kind, int(digits[0]) // 8 if digits else 0)
        total += math.prod(map(int, filter(None, axes.split(",")))) * width
    return total


def operands_of(rest: str) -> tuple[str, ...]:
    """The names in the brackets that a line begins with."""
    depth = 1
    for place, letter in enumerate(rest):
        depth += (letter in "([{") - (letter in ")]}")
        if not depth:
            return tuple(re.findall(r"%([\w.\-]+)", rest[:place]))
    return ()


def computations_of(text: str) -> dict[str, list[Instruction]]:
    """The computations of a compiled program by name."""
    found, current = {}, None
    for line in re.sub(r"/\*.*?\*/", "", text).splitlines():
        head = re.match(r"^(?:ENTRY )?%?([\w.\-]+) \(.*\{\s*$", line)
        if head and " = " not in line.split("->")[0]:
            current = found.setdefault(head[1], [])
        elif current is not None and (match := INSTRUCTION.match(line)):
            _, name, shape, kind, rest = match.groups()
            current.append(Instruction(name, shape, kind, operands_of(rest), line))
    return found


def needed_of(inner: list[Instruction]) -> dict[str, float]:
    """How many bytes of each instruction of a fusion are needed for its result, the last instruction."""
    sizes = {one.name: bytes_of_shape(one.shape) for one in inner}
    elsewhere = {one.name: 0.0 for one in inner}
    parts = dict(elsewhere)
    needed = {}
    for one in reversed(inner):
        whole = sizes[one.name]
        needed[one.name] = whole if one is inner[-1] else min(whole, max(elsewhere[one.name], parts[one.name]))
        share = needed[one.name] / max(whole, 1)
        for place, name in enumerate(one.operands):
            if one.kind in PARTS and place == 0:
                parts[name] += needed[one.name]
            elif one.kind == "dynamic-update-slice" and place == 0:
                continue  # Replaced in place.
            else:
                elsewhere[name] = max(elsewhere[name], sizes[name] * min(1.0, share))
    return needed


class Program:
    """A compiled program, and what its instructions move."""

    def __init__(self, text: str):
        self.computations = computations_of(text)

    def inside(self, instruction: Instruction) -> list[Instruction]:
        """What a fusion is made of, or what it calls."""
        return self.computations[instruction.called("calls") or instruction.called("to_apply")]

    def moved(self, instruction: Instruction, shapes: dict[str, str]) -> int:
        """Bytes that one kernel reads and writes."""
        out = bytes_of_shape(instruction.shape)
        if instruction.kind == "custom-call" and instruction.shape.startswith("("):
            out -= sum(bytes_of_shape(found[0]) for found in WORKSPACE.finditer(instruction.shape))
        if instruction.kind in PARTS:
            return 2 * out
        if instruction.kind == "dynamic-update-slice":
            return 2 * bytes_of_shape(shapes[instruction.operands[1]])
        if instruction.kind != "fusion":
            return out + sum(bytes_of_shape(shapes[name]) for name in instruction.operands)
        inner = self.inside(instruction)
        by_name = {one.name: one for one in inner}
        needed = needed_of(inner)
        read = sum(needed[one.name] for one in inner if one.kind == "parameter")
        root = inner[-1]
        roots = [by_name[name] for name in root.operands] if root.kind == "tuple" else [root]
        return int(read + sum(self.written_by(one, by_name) for one in roots))

    def written_by(self, root: Instruction, by_name: dict[str, Instruction]) -> int:
        """Bytes that a fusion writes of one result: what is replaced alone."""
        while root.kind == "bitcast" and root.operands[0] in by_name:
            root = by_name[root.operands[0]]
        if root.kind == "dynamic-update-slice":
            return bytes_of_shape(by_name[root.operands[1]].shape)
        return bytes_of_shape(root.shape)

    def kernels(self, computation: str) -> list[tuple[Instruction, int]]:
        """The kernels of a computation with the bytes of each, those of inner loops as often as they run."""
        shapes = {one.name: one.shape for one in self.computations[computation]}
        found = []
        for one in self.computations[computation]:
            if one.kind in FREE or one.kind.endswith("-done"):
                continue
            if one.kind == "while":
                found += self.kernels(one.called("body")) * self.trips(one)
            elif one.kind in ("call", "async-start") and (one.called("to_apply") or one.called("calls")):
                found += self.kernels(one.called("to_apply") or one.called("calls"))
            elif one.kind == "conditional":
                branches = re.findall(r"%([\w.\-]+)", re.search(r"branch_computations=\{([^}]*)\}", one.line)[1])
                found += max(map(self.kernels, branches), key=lambda kernels: sum(size for _, size in kernels))
            else:
                found.append((one, self.moved(one, shapes)))
        return found

    def trips(self, loop: Instruction) -> int:
        """How often a loop runs; once where the compiler does not say."""
        found = re.search(r'known_trip_count"?:\{"n":"(\d+)"', loop.line)
        return int(found[1]) if found else 1

    def largest_loop(self) -> list[tuple[Instruction, int]]:
        """The kernels of the loop that moves most, over all of its turns."""
        loops = [one for inner in self.computations.values() for one in inner if one.kind == "while"]
        return max(
            (self.kernels(one.called("body")) * self.trips(one) for one in loops),
            key=lambda kernels: sum(size for _, size in kernels),
        )


def kind_of(kernel: Instruction) -> str:
    """What a kernel is there for, as its name says."""
    words = f"{kernel.kind} {kernel.name} {kernel.called('calls') or ''} {kernel.line.partition('metadata')[2]}"
    for kind, pattern in KINDS.items():
        if re.search(pattern, words):
            return kind
    return "other loops"


KINDS = {
    "products": r"\bdot\b|gemm|custom-call|dot_general|__cublas|matmul",
    "transposes and copies": r"transpose_fusion|wrapped_transpose|\bcopy|copy_fusion|wrapped_copy",
    "concatenations": r"concatenate",
    "reductions": r"reduce",
    "gathers and slices": r"gather|slice",
}


def loop_of_updates(train, num_seeds: int, updates_per_epoch: int):
    """An epoch's updates of seeds side by side, and the shapes of its arguments."""

    def start(key, hyper, env):
        return train.initial(key, hyper, env)

    def epoch(state, key, hyper, env):
        setup = train.setup(hyper, env)
        experience, state = make_experience(setup, state, 0)
        state, metrics = updates(setup, experience, state, key, updates_per_epoch)
        return state, metrics

    hyper, env = train.config.hyper, train.env
    keys = jax.random.split(jax.random.key(0), num_seeds)
    states = jax.eval_shape(jax.vmap(start, in_axes=(0, None, None)), keys, hyper, env)
    return jax.vmap(epoch, in_axes=(0, 0, None, None)), (states, keys, hyper, env)


def least(train) -> dict[str, int]:
    """The least bytes that an update of one seed has to move, by what they are."""
    hyper, env, config = train.config.hyper, train.env, train.config
    setup, key = train.setup(hyper, env), jax.random.key(0)
    state = jax.eval_shape(train.initial, key, hyper, env)

    def one(state, key):
        experience, state = make_experience(setup, state, 0)
        drawn = sample(setup, experience, key)
        return drawn, update(setup, experience, state, drawn, key)[0].params

    drawn, _ = jax.eval_shape(one, state, key)
    parameters = size_of(state.params)
    seen = jax.eval_shape(lambda: env.render(env.observe(env.reset(jax.random.key(0)))))
    goal = jax.eval_shape(lambda: env.goals.inputs_of(env.goals.examples[0]))
    asked = [drawn.transitions.desired_goal, drawn.goals, drawn.all_goals]
    asked += [] if drawn.relabelled is None else [drawn.relabelled.desired_goal]
    pairs = drawn.pairs
    asked += [] if pairs is None else [pairs.anchor, pairs.positive, pairs.negative, pairs.other]
    axes = len(env.goals.shape)
    goals = sum(math.prod(some.shape[: some.ndim - axes]) for some in asked if some is not None)
    goals = min(goals, env.goals.num_goals) if env.goals.finite else goals
    states = 2 * config.batch_size
    states = states if env.num_observations is None else min(states, env.num_observations)
    program = jax.make_jaxpr(lambda state, experience, drawn, key: update(setup, experience, state, drawn, key))
    experience = jax.eval_shape(lambda state: make_experience(setup, state, 0)[0], state)
    made = products(program(state, experience, drawn, key))
    return {
        "inputs": states * size_of(seen) + goals * size_of(goal),
        "parameters, target, moments": 8 * parameters,
        "what products make": made,
    }


def products(program) -> int:
    """Bytes of what the products of a traced program make, inner programs included."""
    jaxpr, total = getattr(program, "jaxpr", program), 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            total += size_of([variable.aval for variable in equation.outvars])
        branches = equation.params.get("branches")
        if branches:  # Those of devices: one of them runs.
            total += products(branches[0])
            continue
        for value in equation.params.values():
            total += sum(products(inner) for inner in inner_programs(value))
    return total


def size_of(tree) -> int:
    """Bytes of all arrays of a tree."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def mebibytes(count: float) -> str:
    """A count of bytes in MiB."""
    return f"{count / 2**20:,.1f}"


def print_budget(train, kernels: list, num_seeds: int, num_updates: int, largest: int) -> None:
    """The tables of one task."""
    each = num_seeds * num_updates
    total, count = sum(size for _, size in kernels) / each, len(kernels) / num_updates
    needed = least(train)
    enough = sum(needed.values())
    parameters = sum(
        leaf.size
        for leaf in jax.tree.leaves(
            jax.eval_shape(lambda: train.initial(jax.random.key(0), train.config.hyper, train.env).params)
        )
    )
    print(
        f"{mebibytes(total)} MiB an update and seed, {total / enough:.1f} times the least, {mebibytes(enough)} MiB; "
        f"{count:.0f} kernels an update of all seeds; {parameters:,} parameters\n"
    )
    print("| the least | MiB |\n|---|---|")
    for name, size in needed.items():
        print(f"| {name} | {mebibytes(size)} |")
    by_kind: dict[str, list[int]] = {}
    for kernel, size in kernels:
        by_kind.setdefault(kind_of(kernel), []).append(size)
    print("\n| kernels | an update | MiB | share |\n|---|---|---|---|")
    for kind, sizes in sorted(by_kind.items(), key=lambda pair: -sum(pair[1])):
        share = sum(sizes) / each / total
        print(f"| {kind} | {len(sizes) / num_updates:.0f} | {mebibytes(sum(sizes) / each)} | {share:.0%} |")
    by_name: dict[str, tuple[Instruction, int]] = {}
    for kernel, size in kernels:
        before = by_name.get(kernel.name, (kernel, 0))[1]
        by_name[kernel.name] = kernel, before + size
    print("\n| largest kernels | makes | MiB | from |\n|---|---|---|---|")
    for kernel, size in sorted(by_name.values(), key=lambda pair: -pair[1])[:largest]:
        shapes = " ".join(f"{kind}[{axes}]" for kind, axes in ARRAY.findall(kernel.shape)[:4])
        print(f"| {kernel.name} | {shapes} | {mebibytes(size / each)} | {kernel.place[-90:]} |")
    print(flush=True)


def main() -> None:
    """Compile, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tasks = ["object_manipulation", "fetch_pick_and_place", "object_search"]
    parser.add_argument("--tasks", nargs="+", choices=presets.TASKS, default=tasks)
    parser.add_argument("--method", default="infogoal")
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--bfloat16", action="store_true", help="in layers")
    parser.add_argument("--largest", type=int, default=12, help="kernels that are listed")
    arguments = parser.parse_args()
    print(f"{arguments.method}, {arguments.seeds} seeds; {describe_machine()}\n")
    for task in arguments.tasks:
        train = make_train(presets.load(task, arguments.method, bfloat16=arguments.bfloat16))
        loop, given = loop_of_updates(train, arguments.seeds, UPDATES)
        program = Program(compiled(loop, *given).as_text())
        print(f"## {task}\n")
        print_budget(train, program.largest_loop(), arguments.seeds, UPDATES, arguments.largest)


UPDATES = 100
"""Of an epoch that is counted: enough that the loop over them is a loop."""


if __name__ == "__main__":
    main()

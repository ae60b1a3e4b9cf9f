"""Object search is a faithful walk over its graph. Embodied question answering: goals that are known, recorded flights
as rows, learning without acting, and datasets that cannot be used."""

import dataclasses
import json

import hand_made
import hand_made_frames
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import make_train, presets
from infogoal_jax.agents.cql import CQLConfig
from infogoal_jax.config import StateEncoderConfig
from infogoal_jax.data import splits
from infogoal_jax.envs import load, object_search
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig, from_data
from infogoal_jax.envs.environment import data_of
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train.episodes import rollout
from infogoal_jax.train.evaluation import draw_starts, evaluate, group_means, random_policy
from infogoal_jax.train.experience import make_experience
from infogoal_jax.train.update import sample


@pytest.fixture(scope="module")
def house():
    return hand_made.environment()


def test_distances_are_shortest_paths(house):
    """Against relaxation over every edge until nothing changes."""
    edges, in_view = np.asarray(house.next_node), np.asarray(house.in_view)
    expected = np.where(in_view.T, 0, 10_000)
    for _ in range(len(edges)):
        expected = np.minimum(expected, expected[:, edges].min(-1) + 1)
    np.testing.assert_array_equal(object_search.distances(edges, in_view), expected)


def test_a_grey_image_that_is_seen_is_drawn_in_three_equal_colours(house):
    state = house.reset(jax.random.key(0))
    picture = np.asarray(house.draw(state))
    np.testing.assert_array_equal(picture, np.asarray(house.images)[state.node][..., None].repeat(3, -1))


def test_episodes_start_with_the_goal_out_of_view_and_a_training_goal(house):
    states = jax.jit(jax.vmap(house.reset))(jax.random.split(jax.random.key(0), 500))
    assert not house.reached(states.node, states.desired_goal).any()
    np.testing.assert_array_equal(np.unique(states.desired_goal), np.flatnonzero(np.asarray(house.goals.train_mask)))
    assert len(np.unique(states.node)) > 40


def test_steps_without_an_edge_stay_in_place_and_are_masked(house):
    nodes = jnp.arange(house.num_observations)
    mask = house.action_mask(nodes)
    np.testing.assert_array_equal(house.next_node == nodes[:, None], ~mask)
    assert mask[:, 4:].all()  # Rotation is always possible here.


def test_termination_and_truncation_are_never_confused(house):
    state = house.reset_to(jax.random.key(0), jnp.asarray(0))
    ends = []
    for _ in range(house.episode_length):
        state = house.step(state, jnp.asarray(4))  # Turning on the spot.
        ends.append((bool(state.terminated), bool(state.truncated)))
    assert (True, True) not in ends
    if not any(terminated for terminated, _ in ends):
        assert ends[-1] == (False, True) and (False, True) not in ends[:-1]


def test_achieved_goals_agree_with_what_is_reached(house):
    for node in range(house.num_observations):
        goals = [int(goal) for goal in house.goals_of(jnp.asarray(node)) if goal >= 0]
        assert goals == [
            goal for goal in range(house.goals.num_goals) if bool(house.reached(jnp.asarray(node), jnp.asarray(goal)))
        ]


def test_a_memory_has_the_start_at_reset_and_then_the_places_of_a_walk():
    """From the end of room 0 to the crossing and into room 1: the plan is a cross of 16 x 16 cells, x by rows."""
    env = hand_made.environment_from_above(memory=True)
    state = env.reset_to(jax.random.key(0), jnp.asarray(0))
    assert np.flatnonzero(state.visited).tolist() == [int(env.cell[state.node])]
    state = state.replace(node=jnp.asarray(4 * 3), visited=env.visit(jnp.zeros_like(state.visited), jnp.asarray(4 * 3)))
    levels = [np.asarray(state.visited).reshape(16, 16)]
    for action in ("backward", "backward", "backward", "rotate_ccw", "forward"):
        state = env.step(state, jnp.asarray(env.action_names.index(action)))
        levels.append(np.asarray(state.visited).reshape(16, 16))
    assert np.argwhere(levels[0]).tolist() == [[15, 8]]
    assert np.argwhere(levels[3]).tolist() == [[8, 8], [10, 8], [13, 8], [15, 8]]
    assert np.argwhere(levels[-1]).tolist() == [[8, 8], [8, 10], [10, 8], [13, 8], [15, 8]]
    assert levels[-1][8, 10] == 255 > levels[-1][8, 8] > levels[-1][10, 8] > levels[-1][15, 8] > 0


def test_a_memory_never_forgets_a_place_however_long_the_episode():
    env = hand_made.environment_from_above(memory=True, episode_length=600)
    visit = jax.jit(env.visit)
    visited = visit(np.zeros(256, np.uint8), 0)
    for _ in range(300):
        visited = visit(visited, 12)
    assert set(np.unique(visited).tolist()) == {0, 1, 255}


def test_the_state_encoder_sees_a_memory_and_episodes_without_one_are_the_same(house):
    env = hand_made.environment_from_above(memory=True)
    visit, render = jax.jit(env.visit), jax.jit(env.render)
    here = visit(np.zeros(256, np.uint8), 0)
    there = visit(here, 12)
    seen = [np.asarray(render(object_search.Remembered(12, visited))) for visited in (here, there)]
    assert seen[0].shape == (8, 8, 2) and seen[0].dtype == jnp.uint8
    np.testing.assert_array_equal(seen[0][..., 0], house.images[12])
    assert (seen[0][..., 1] != seen[1][..., 1]).any()
    train = make_train(hand_made.config("none", env=REMEMBERING), env)
    features = jax.jit(train.parts.state_encoder.apply)
    params = jax.jit(train.parts.state_encoder.init)(jax.random.key(0), seen[0])
    assert (features(params, seen[0]) != features(params, seen[1])).any()
    states = [jax.jit(each.reset)(jax.random.key(3)) for each in (env, house)]
    assert states[0].node == states[1].node and env.observe(states[0]).image == house.observe(states[1])


REMEMBERING = object_search.ObjectSearchConfig(episode_length=20, image_size=8, memory=True)


def test_a_memory_is_refused_where_images_do_not_say_where_they_were_taken_and_beside_a_bonus():
    unknown = np.full((52, 3), np.nan, np.float32)
    with pytest.raises(UserError, match="env.memory = True: 52 of 52 images .* do not say where they were taken"):
        hand_made.environment(position=unknown, memory=True)
    with pytest.raises(UserError, match="observations do not form a finite set"):
        make_train(hand_made.config("sse_db", env=REMEMBERING))


def with_a_memory(method):
    """Training of the method on the rooms with a memory."""
    config = hand_made.config(method, env=REMEMBERING, num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=2)
    return make_train(config, hand_made.environment_from_above(memory=True))


def test_methods_fit_a_memory():
    """Traced, not run."""
    result = jax.eval_shape(with_a_memory("her"), jax.random.key(0))
    assert result.metrics["test_goal/success_rate"].shape == (1,)


@pytest.mark.long
@pytest.mark.parametrize("method", ["her", "infogoal"])
def test_methods_train_with_a_memory(method):
    result = jax.jit(with_a_memory(method))(jax.random.key(0))
    assert all(np.isfinite(value).all() for value in result.metrics.values())


def test_oracle_takes_shortest_paths_and_random_does_not(house):
    goals = house.goals.evaluated
    shortest, drawn = (
        jax.jit(lambda policy=policy: evaluate(policy(house), house, goals))()
        for policy in (hand_made.shortest_path_policy, random_policy)
    )
    assert shortest.success.shape == (len(goals), 10) and shortest.success.all() and (shortest.spl == 1).all()
    assert set(group_means(drawn, house.goals)) == {"train", "test"}
    assert all(means["spl"] < 0.7 for means in group_means(drawn, house.goals).values())
    lengths = jax.jit(lambda: jax.vmap(jax.vmap(house.shortest_path))(draw_starts(house, goals, 10)))
    np.testing.assert_array_equal(shortest.first, lengths())


def test_a_failed_goal_counts_as_reached_after_the_end(house):
    goals = house.goals.evaluated
    stay = jax.jit(lambda: evaluate(lambda observation, goal, key: jnp.full(goal.shape, 4), house, goals, 5))()
    first = stay.first
    assert not stay.success.all() and (first[~stay.success] == house.episode_length + 1).all()


def test_an_object_out_of_reach_is_named():
    scenes = hand_made.scenes()
    scenes.visible[:, 2] = False
    with pytest.raises(UserError, match="train_2"):
        object_search.from_data(scenes, hand_made.SPLIT, np.zeros((8, 4), np.float32), 20)


def test_a_split_without_training_objects_is_refused():
    split = splits.make_split({name: ("room", "test") for name in hand_made.SPLIT.objects})
    with pytest.raises(UserError, match="training object"):
        object_search.from_data(hand_made.scenes(), split, np.zeros((8, 4), np.float32), 20)


def told_again(path, objects, make):
    """What the data are with a file of these objects, and once the last training object of it is for the test."""
    for _ in range(2):
        path.write_text(json.dumps({"objects": objects}))
        yield data_of(make(str(path)))
        last = [name for name in objects if objects[name]["use"] == "train"][-1]
        objects = objects | {last: objects[last] | {"use": "test"}}


def test_other_uses_of_the_same_goals_are_other_data(tmp_path):
    """Or a run would go on with other training goals, and call those that it was trained on unseen."""
    split, asked = splits.AUTHORS_SPLIT, json.loads(splits.SHIPPED_QUESTIONS.read_text())["objects"]
    uses = {name: use for use in ("train", "validation", "test") for name in getattr(split, use)}
    placed = {name: {"room": split.room_names[split.rooms[name]], "use": use} for name, use in uses.items()}
    kinds = {
        "split": (placed, lambda path: load("object_search", ObjectSearchConfig(split=path))),
        "questions": (asked, lambda path: load("embodied_qa", EmbodiedQAConfig(questions=path))),
    }
    for name, (objects, make) in kinds.items():
        assert make("").source in (first := next(told := told_again(tmp_path / name, objects, make)))
        assert next(told) != first


@pytest.fixture(scope="module")
def env():
    """The hand-made shelf with its questions."""
    return hand_made_frames.qa()


def test_goals_and_what_is_known_of_them(env):
    """Names and training questions can be achieved; questions of validation and test never are, though their objects
    are detected."""
    goals = env.goals
    assert (
        goals.num_goals,
        int(goals.train_mask.sum()),
        int(goals.validation_mask.sum()),
        int(goals.test_mask.sum()),
    ) == (4 + 2 + 8 + 8, 2, 8, 8)
    known = np.asarray(env.goals_of(jnp.arange(env.num_observations)))
    hidden = np.asarray(goals.validation_mask | goals.test_mask)
    assert not hidden[known[known >= 0]].any()
    for goal in range(goals.num_goals):
        seen = np.asarray(env.reached(jnp.arange(env.num_observations), jnp.full(env.num_observations, goal)))
        owner = next(number for number, name in enumerate(hand_made_frames.OBJECTS) if name in goals.names[goal])
        np.testing.assert_array_equal(seen, hand_made_frames.shelf().detected[:, owner])
        if not hidden[goal]:
            np.testing.assert_array_equal((known == goal).any(1), seen)


def test_flights_become_rows(env):
    """Every recorded move is a valid transition, in its order; each flight has one training goal; nothing is
    terminated."""
    data, rows = hand_made_frames.shelf(), env.recorded
    assert int(rows.valid.sum()) == len(data.frame)
    np.testing.assert_array_equal(np.asarray(rows.observation)[data.trajectory, data.time], data.frame)
    np.testing.assert_array_equal(np.asarray(rows.observation)[data.trajectory, data.time + 1], data.next_frame)
    np.testing.assert_array_equal(np.asarray(rows.action)[data.trajectory, data.time], data.action)
    assert bool(env.goals.train_mask[rows.desired_goal].all()) and not rows.terminated.any()
    assert (rows.desired_goal == rows.desired_goal[:, :1]).all()


def moves_of(data, rows) -> dict[str, np.ndarray]:
    """These of the recorded moves."""
    names = ("frame", "action", "next_frame", "trajectory", "time", "terminal")
    return {name: getattr(data, name)[rows] for name in names}


def test_flights_of_different_lengths():
    """Shorter flights are padded with transitions that are never drawn."""
    data = hand_made_frames.shelf()
    keep = ~((data.trajectory == 3) & (data.time > 4))
    moves = moves_of(data, keep)
    moves["terminal"] = moves["terminal"] | ((moves["trajectory"] == 3) & (moves["time"] == 4))
    env = from_data(
        dataclasses.replace(data, **moves),
        hand_made_frames.asked(),
        hand_made_frames.embeddings(),
        EmbodiedQAConfig(episode_length=15),
    )
    assert env.recorded.valid[3].sum() == 5 and int(env.recorded.valid.sum()) == keep.sum()


def test_what_no_flight_saw_is_not_achieved():
    """The places of a row after a shorter flight are no visits to the first image: a goal that is in view there alone
    stays unseen, and dissimilar to all others."""
    data = hand_made_frames.shelf()
    passes_first = np.isin(data.trajectory, data.trajectory[(data.frame == 0) | (data.next_frame == 0)])
    moves = moves_of(data, ~passes_first & ((data.trajectory % 2 == 0) | (data.time <= 2)))
    last = np.append(moves["trajectory"][1:] != moves["trajectory"][:-1], True)
    moves |= {"trajectory": np.unique(moves["trajectory"], return_inverse=True)[1].astype(np.int32), "terminal": last}
    data = dataclasses.replace(data, **moves)
    env = from_data(data, hand_made_frames.asked(), hand_made_frames.embeddings(), EmbodiedQAConfig(episode_length=15))
    known = np.array(env.achieved_goals)
    goal = known[0, 0]
    known[1:][known[1:] == goal] = -1
    env = env.replace(achieved_goals=jnp.asarray(known))
    train = make_train(hand_made_frames.qa_config("infogoal"), env)

    @jax.jit
    def learned_from(env):
        state = train.initial(jax.random.key(0), train.config.hyper, env)
        experience, _ = make_experience(train.setup(env=env), state, 0)
        return state.seen, state.dissimilarity, experience.achieved_count[-1]

    seen, dissimilar, count = jax.device_get(learned_from(env))
    flown = np.concatenate([data.frame, data.next_frame[last]])
    assert not env.recorded.valid.all() and count == (known[flown] >= 0).any(1).sum()
    assert np.array_equal(np.flatnonzero(seen), np.unique(known[flown][known[flown] >= 0]))
    assert dissimilar[goal].sum() == env.goals.num_goals - 1


def test_random_policy_and_shortest_path(env):
    """The oracle answers every question on a shortest path."""
    shortest, drawn = hand_made.shortest_and_random(env, 10)
    assert shortest.success.all() and (shortest.spl == 1.0).all()
    assert drawn.success.mean() < 1.0


def test_nothing_is_collected(env):
    """Traced, not run: no environment steps, and no buffer beside the recorded flights."""
    train = make_train(hand_made_frames.qa_config("none"), env)
    result = jax.eval_shape(train, jax.random.key(0), None, env)
    assert result.state.buffer is None and result.state.env_states is None
    assert not any(name.startswith("collect/") for name in result.epochs)


@pytest.mark.long
def test_learns_from_flights_alone(env):
    """CQL over relabelled flights reaches training questions far more often than chance."""
    config = hand_made_frames.qa_config(
        "none",
        num_epochs=4,
        epochs_per_evaluation=4,
        updates_per_epoch=250,
        batch_size=128,
        evaluation_starts=8,
        agent=CQLConfig(hidden=(64, 64)),
        state_encoder=StateEncoderConfig(features=64),
        hyper=presets.load("embodied_qa", "none").hyper.replace(discount=0.9),
    )
    train = make_train(config, env)
    result = jax.jit(train)(jax.random.key(0), env=env)
    chance = jax.jit(lambda env: evaluate(random_policy(env), env, env.goals.training_goals, 8))(env).success.mean()
    assert result.metrics["train_goal/success_rate"][-1] > max(0.9, chance)
    assert int(result.state.env_steps) == int(env.recorded.valid.sum())


def test_infogoal_pairs_come_from_the_flights(env):
    """Goals seen within the window of a flight are no longer dissimilar, others are; seeds share one dataset and differ
    in their draws."""
    train = make_train(hand_made_frames.qa_config("infogoal"), env)
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(
        jax.random.split(jax.random.key(0), 2), train.config.hyper, env
    )
    window, seen_together = train.config.learner.window, np.zeros((env.goals.num_goals,) * 2, bool)
    goals = np.asarray(env.goals_of(env.recorded.record))
    for flight in goals:
        for step in range(len(flight)):
            for lag in range(window + 1):
                if step + lag < len(flight):
                    first, second = flight[step][flight[step] >= 0], flight[step + lag][flight[step + lag] >= 0]
                    seen_together[np.ix_(first, second)] = seen_together[np.ix_(second, first)] = True
    seen_together |= np.eye(len(seen_together), dtype=bool)
    for seed in range(2):
        np.testing.assert_array_equal(states.dissimilarity[seed], ~seen_together)
    assert bool((states.seen[0] == jnp.asarray(np.isin(np.arange(env.goals.num_goals), goals))).all())


def refused(change: dict, message: str, asked=None):
    """The dataset with this change is refused in these words."""
    data = dataclasses.replace(hand_made_frames.shelf(), **change)
    with pytest.raises(UserError, match=message):
        from_data(
            data, asked or hand_made_frames.asked(), hand_made_frames.embeddings(), EmbodiedQAConfig(episode_length=15)
        )


def test_datasets_that_cannot_be_used():
    """The error says what is missing and what to do."""
    refused({"detected": None}, "tells no detections")
    data = hand_made_frames.shelf()
    never = ~np.isin(
        data.trajectory, np.unique(data.trajectory[data.detected[data.frame, 0] | data.detected[data.next_frame, 0]])
    )
    refused(moves_of(data, never), "no trajectory ever reaches the training goal red mug|can be found from nowhere")
    refused(
        {"objects": ("red mug", "blue book", "green ball", "door")},
        "old clock.*of the questions are detected nowhere in .*--env.questions FILE",
    )
    refused(moves_of(data, slice(0)), "no recorded moves")


@pytest.mark.long
def test_questions_of_the_test_are_never_learned_from(env):
    """Under the preset no draw of an update, relabelled goal or pair, is a question of validation or test."""
    train = make_train(hand_made_frames.qa_config("infogoal"), env)
    state = jax.jit(train.initial)(jax.random.key(0), train.config.hyper, env)

    @jax.jit
    def draws(state, keys):
        experience, _ = make_experience(train.setup(env=env), state, 0)
        return jax.vmap(lambda key: sample(train.setup(env=env), experience, key))(keys)

    drawn = draws(state, jax.random.split(jax.random.key(1), 50))
    hidden = np.asarray(env.goals.validation_mask | env.goals.test_mask)
    used = (drawn.transitions.desired_goal, drawn.pairs.anchor, drawn.pairs.positive, drawn.pairs.negative)
    for goals in used:
        assert not hidden[np.asarray(goals)].any()
    assert len(np.unique(drawn.transitions.desired_goal)) == int((~hidden).sum())  # All others come up.


def test_goals_have_names(house):
    policy, key, name = random_policy(house), jax.random.key(0), house.goals.names[1]

    @jax.jit
    def played(key):
        goals = (name, 1)
        alone = [rollout(house, policy, goal, key).steps for goal in goals]
        return alone, [evaluate(policy, house, [goal], 2).steps for goal in goals]

    for one, same in played(key):
        np.testing.assert_array_equal(one, same)

"""Networks and advantages: the same without PyTorch, blind to order, and discounted by time."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import gymnasium  # noqa: E402
from gymnasium import spaces  # noqa: E402
from sb3_contrib import MaskablePPO  # noqa: E402

from agents.frontier_env import as_observation, choice_space  # noqa: E402
from agents.learned import choice_network  # noqa: E402
from agents.learned.choice import CANDIDATE, STATE, Choice, mirrored  # noqa: E402
from agents.learned.chooser import ChooserConfig  # noqa: E402
from slam.settings import from_mapping  # noqa: E402
from training.learning.choice_world import Whole, make_world  # noqa: E402
from training.learning.config import TrainConfig, WorldConfig  # noqa: E402
from training.learning.networks import ChoiceNetwork  # noqa: E402
from training.learning.ppo import _stages  # noqa: E402
from training.learning.semi_markov import Durations, SemiMarkovBuffer  # noqa: E402

CONFIG = ChooserConfig()


def a_choice(m: int, seed: int = 0) -> Choice:
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 2.0, (m, 2))
    return Choice(
        np.arange(m),
        rng.normal(size=(m, len(CANDIDATE))).astype(np.float32),
        rng.integers(0, 256, (m, 4, 16, 16)).astype(np.uint8),
        np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)).astype(np.float32),
        rng.normal(size=len(STATE)).astype(np.float32),
    )


def network(seed: int = 0) -> ChoiceNetwork:
    torch.manual_seed(seed)
    made = ChoiceNetwork(len(CANDIDATE), 4 * 16 * 16, len(STATE))
    for p in made.parameters():
        torch.nn.init.normal_(p, std=0.15)
    return made


def scores(made: ChoiceNetwork, choice: Choice) -> tuple[np.ndarray, float]:
    """Return the scores, and the value."""
    observation = {k: torch.as_tensor(v)[None] for k, v in as_observation(choice, choice_space(CONFIG)).items()}
    with torch.no_grad():
        tokens = made.tokens(observation)
        value = made.value(tokens, observation["present"])
        return made.scores(tokens)[0, : len(choice.index)].numpy(), float(value[0, 0])


@pytest.mark.parametrize("m", [1, 2, 9, 24])
def test_numpy_and_torch_agree(m):
    made = network(m)
    weights = {name: value.numpy() for name, value in made.state_dict().items()}
    light = choice_network.ChoiceNetwork(weights, heads=4)
    choice = a_choice(m, m)
    np.testing.assert_allclose(light.scores(choice), scores(made, choice)[0], atol=2e-4)


def test_an_ensemble_chooses_by_the_mean_of_its_members_logarithms_in_both_views():
    members = [{name: value.numpy() for name, value in network(seed).state_dict().items()} for seed in range(3)]
    together = choice_network.ChoiceEnsemble(choice_network.joined(members), heads=4)
    alone = choice_network.ChoiceEnsemble(choice_network.joined(members[:1]), heads=4)
    assert choice_network.joined(members[:1]).keys() == members[0].keys()
    assert [own.keys() for own in choice_network.apart(choice_network.joined(members))] == [members[0].keys()] * 3
    choice = a_choice(9)
    views = choice, mirrored(choice)
    chances = [
        [torch.as_tensor(scores(network(seed), view)[0]).softmax(dim=0).numpy() for view in views]
        for seed in range(3)
    ]
    assert not np.allclose(chances[0][0], chances[0][1], atol=1e-3), "to one network left and right are not alike"
    np.testing.assert_allclose(together.scores(choice), np.log(chances).mean(axis=(0, 1)), atol=2e-4)
    np.testing.assert_allclose(alone.scores(choice), np.log(chances[0]).mean(axis=0), atol=2e-4)
    np.testing.assert_allclose(together.scores(mirrored(choice)), together.scores(choice), atol=2e-4)
    damaged = choice_network.joined(members)
    del damaged["members.1.token.weight"]
    with pytest.raises(ValueError, match=r"weight token.weight is missing"):
        choice_network.ChoiceEnsemble(damaged, heads=4)


def test_permuted_candidates_get_permuted_scores():
    made, choice = network(), a_choice(11)
    p = np.random.default_rng(1).permutation(11)
    turned = Choice(p, choice.candidates[p], choice.patches[p], choice.distances[np.ix_(p, p)], choice.state)
    one, worth = scores(made, choice)
    other, same = scores(made, turned)
    np.testing.assert_allclose(other, one[p], atol=1e-4)
    assert same == pytest.approx(worth, abs=1e-4)


def test_damaged_weights_are_named():
    weights = {name: value.numpy() for name, value in network().state_dict().items()}
    with pytest.raises(ValueError, match=r"weight score.weight has the shape \(2, 64\)"):
        choice_network.ChoiceNetwork(weights | {"score.weight": np.zeros((2, 64), np.float32)}, heads=4)
    del weights["token.weight"]
    with pytest.raises(ValueError, match=r"weight token.weight is missing"):
        choice_network.ChoiceNetwork(weights, heads=4)


def test_advantages_against_the_sums_they_stand_for():
    """γ^duration for γ; with λ = 1 the advantage is the discounted sum to the end less the value."""
    rng = np.random.default_rng(0)
    steps, gamma = 12, 0.9
    space = choice_space(CONFIG)
    for lam in (1.0, 0.6):
        buffer = SemiMarkovBuffer(
            steps, space, spaces.Discrete(24), gamma=gamma, gae_lambda=lam, n_envs=2, device="cpu"
        )
        buffer.reset()
        values, rewards = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 2))
        durations = rng.uniform(0.3, 2.0, (steps, 2))
        starts = np.zeros((steps, 2))
        starts[5, 0] = 1.0  # an episode of the first environment ended with step 4
        buffer.rewards, buffer.values = rewards.astype(np.float32), values[:-1].astype(np.float32)
        buffer.durations, buffer.episode_starts = durations.astype(np.float32), starts.astype(np.float32)
        dones = np.array([False, True])
        buffer.compute_returns_and_advantage(torch.as_tensor(values[-1:], dtype=torch.float32), dones)
        for e in range(2):
            for t in range(steps):
                total, weight = 0.0, 1.0
                for k in range(t, steps):
                    last = bool(dones[e]) if k == steps - 1 else starts[k + 1, e] == 1.0
                    g = gamma ** durations[k, e]
                    total += weight * (rewards[k, e] + (0.0 if last else g * values[k + 1, e]) - values[k, e])
                    weight *= g * lam
                    if last:
                        break
                assert buffer.advantages[t, e] == pytest.approx(total, abs=1e-4)


class _Halting(gymnasium.Env):
    """Steps of three seconds that pay nothing; each second one an episode is broken off."""

    observation_space = spaces.Dict({"x": spaces.Box(-1.0, 1.0, (1,))})
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._steps = 0
        return {"x": np.zeros(1, np.float32)}, {}

    def step(self, action):
        self._steps += 1
        return {"x": np.full(1, 0.7, np.float32)}, 0.0, False, self._steps == 2, {"duration_s": 3.0}

    def action_masks(self):
        return np.ones(2, np.bool_)


def test_where_an_episode_is_broken_off_its_value_is_discounted_by_time():
    gamma = 0.8
    model = MaskablePPO(
        "MultiInputPolicy", _Halting(), n_steps=4, batch_size=4, n_epochs=1, gamma=gamma, learning_rate=1e-12,
        rollout_buffer_class=SemiMarkovBuffer, seed=0, device="cpu",
    )  # fmt: skip
    with torch.no_grad():
        value = float(model.policy.predict_values({"x": torch.full((1, 1), 0.7)})[0])
    assert abs(value) > 1e-3
    model.learn(4, callback=Durations())
    np.testing.assert_allclose(model.rollout_buffer.rewards.ravel(), [0, gamma**3 * value] * 2, rtol=1e-4)


class _GivenUp(gymnasium.Env):
    """An episode that ends after 20 s, of which each has cost 0.1."""

    def __init__(self, success: bool, truncated: bool) -> None:
        self._ended = {"time_s": 20.0, "duration_s": 20.0, "is_success": success}, truncated

    def step(self, action):
        info, truncated = self._ended
        return {}, -2.0, not truncated, truncated, info


@pytest.mark.parametrize(
    ("success", "truncated", "charged"), [(True, False, -2.0), (False, True, -2.0), (False, False, -10.0)]
)
def test_giving_up_costs_the_time_until_the_limit(success, truncated, charged):
    world = Whole(_GivenUp(success, truncated), WorldConfig(time_1_s=-0.1, time_limit_s=100.0))
    assert world.step(0)[1] == pytest.approx(charged)
    assert isinstance(make_world(WorldConfig()), Whole)


def test_giving_up_is_discounted_as_the_time_that_it_saves():
    gamma = 0.98
    world = Whole(_GivenUp(False, False), WorldConfig(time_1_s=-0.1, time_limit_s=100.0), gamma=gamma)
    times = np.arange(20.0, 100.0, 1e-3)
    assert world.step(0)[1] == pytest.approx(-2.0 - 0.1 * (gamma**times).sum() * 1e-3, rel=1e-3)


def test_the_reward_of_a_choice_is_discounted_by_time():
    gamma, each_s = 0.9, 0.1
    world = make_world(WorldConfig(rooms=("rectangular",), time_1_s=-0.1), gamma=gamma)
    world.reset(seed=3)
    for _ in range(3):
        _, reward, *_, info = world.step(0)
        times = each_s * np.arange(round(info["duration_s"] / each_s))
        assert reward == pytest.approx(-0.1 * each_s * (gamma**times).sum())
    assert make_world(WorldConfig()).env.discount == 1.0


def test_ppo_learns_where_the_reward_is_discounted_as_it_discounts():
    config = from_mapping(TrainConfig, {"ppo": {"gamma": 0.9}, "rehearsal": {"gamma": 0.8, "steps": 1}})
    rehearsal, in_full = _stages(config)
    assert rehearsal.makers[0]().env.gamma == 0.8
    assert in_full.makers[0]().env.discount ** 10 == pytest.approx(0.9)


def test_a_room_serves_as_many_episodes_as_it_is_told_to():
    world = make_world(WorldConfig(rooms=("rectangular",), repeats=2))
    starts = [world.reset(seed=3 if k == 0 else None)[0]["candidates"] for k in range(4)]
    rooms = []
    for k in range(3):
        world.reset(seed=3 if k == 0 else None)
        rooms.append(world._room)
    assert rooms[0] == rooms[1] != rooms[2]
    # The same room, but not the same noise; and from the same seed all of it again.
    assert not np.array_equal(starts[0], starts[1])
    np.testing.assert_array_equal(world.reset(seed=3)[0]["candidates"], starts[0])

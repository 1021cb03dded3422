"""The network that scores candidates, in NumPy: what was trained runs without PyTorch.

Tokens, one a candidate, look at each other by attention (Vaswani et al., 2017), weaker the farther apart their
view points lie (a bias linear in the distance, as in Press et al., "Train short, test long", ICLR 2022). There are
no positions in the row of candidates: permuted candidates get permuted scores, and any number of them will do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from agents.learned.choice import CANDIDATE, STATE, Choice, mirrored
from agents.learned.layers import Layers
from slam.types import Bytes, Floats

__all__ = ["ChoiceEnsemble", "ChoiceNetwork", "apart", "joined"]


class ChoiceNetwork(Layers):
    """``training.learning.networks.ChoiceNetwork``, what it scores only.

    Parameters
    ----------
    weights : mapping
        As for :class:`agents.learned.layers.Layers`.
    heads : int
        Of the attention.
    """

    def __init__(self, weights: Mapping[str, Floats], *, heads: int) -> None:
        self._heads = heads
        self._layers = len({name.split(".")[1] for name in weights if name.startswith("layers.")})
        super().__init__(weights)

    def scores(self, choice: Choice) -> Floats:
        """Return the score of each candidate ``(m,)``; the policy takes the highest."""
        return self._scores(choice.candidates, choice.patches, choice.distances, choice.state)

    def _scores(self, candidates: Floats, patches: Bytes, distances: Floats, state: Floats) -> Floats:
        """Return the scores ``(…, m)`` of candidates ``(…, m, CANDIDATE)`` and patches ``(…, m, 4, s, s)``."""
        looked = patches.reshape(*patches.shape[:-3], -1).astype(np.float32) / np.float32(255.0)
        x = (
            self._rows("row", candidates)
            + self._rows("patch_2", np.maximum(self._rows("patch_1", looked), 0.0))
            + self._rows("state", state[None])
        )
        x = self._rows("token", np.maximum(x, 0.0))
        for k in range(self._layers):
            x = self._attend(f"layers.{k}.", x, distances)
        return np.asarray(self._rows("score", self._normal("norm", x))[..., 0])

    def _attend(self, layer: str, x: Floats, distances: Floats) -> Floats:
        qkv = self._rows(layer + "qkv", self._normal(layer + "norm_1", x))
        # (…, m, 3, heads, width / heads) → (3, …, heads, m, width / heads)
        q, key, v = np.moveaxis(qkv.reshape(*qkv.shape[:-1], 3, self._heads, -1), (-3, -2), (0, -3))
        reach = np.logaddexp(np.float32(0.0), self._weights[layer + "reach"])
        score = q @ np.swapaxes(key, -1, -2) / np.float32(math.sqrt(q.shape[-1]))
        score = score - reach[..., None, None] * distances
        score = np.exp(score - score.max(axis=-1, keepdims=True))
        score /= score.sum(axis=-1, keepdims=True)
        x = x + self._rows(layer + "out", np.swapaxes(score @ v, -3, -2).reshape(x.shape))
        up = np.maximum(self._rows(layer + "up", self._normal(layer + "norm_2", x)), 0.0)
        return np.asarray(x + self._rows(layer + "down", up))

    def _rows(self, name: str, x: Floats) -> Floats:
        """Return the linear layer of rows ``(…, m, in)``; weights may be of several networks, on axes in front."""
        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return np.asarray(x @ np.swapaxes(weight, -1, -2) + bias[..., None, :])

    def _normal(self, name: str, x: Floats) -> Floats:
        centred = x - x.mean(axis=-1, keepdims=True)
        scale = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + np.float32(1e-5))
        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return np.asarray(centred / scale * weight[..., None, :] + bias[..., None, :])

    def _check(self) -> None:
        width, seen = len(self._weights["norm.bias"]), self._weights["patch_1.weight"].shape[-1]
        linear = {
            "row": (width, len(CANDIDATE)), "state": (width, len(STATE)), "patch_1": (2 * width, seen),
            "patch_2": (width, 2 * width), "token": (width, width), "score": (1, width),
        }  # fmt: skip
        if width % self._heads:
            raise ValueError(f"heads {self._heads} do not divide the width {width}")
        norms = ["norm"]
        for k in range(self._layers):
            norms += [f"layers.{k}.norm_1", f"layers.{k}.norm_2"]
            linear |= {
                f"layers.{k}.qkv": (3 * width, width), f"layers.{k}.out": (width, width),
                f"layers.{k}.up": (2 * width, width), f"layers.{k}.down": (width, 2 * width),
            }  # fmt: skip
            self._expect({f"layers.{k}.reach": (self._heads,)})
        self._expect({f"{name}.weight": shape for name, shape in linear.items()})
        self._expect({f"{name}.bias": shape[:1] for name, shape in linear.items()})
        self._expect({f"{name}.{kind}": (width,) for name in norms for kind in ("weight", "bias")})


class ChoiceEnsemble:
    """Networks that were trained apart and choose together: what one learned by chance the others outvote.

    Each looks twice, the second time in a mirror. What is best does not depend on left and right, what was learned
    does a little.

    Parameters
    ----------
    weights : mapping
        ``members.0.`` and so on before the names of each network's own; or those of a single one.
    heads : int
        Of the attention.
    """

    def __init__(self, weights: Mapping[str, Floats], *, heads: int) -> None:
        self.members = [ChoiceNetwork(own, heads=heads) for own in apart(weights)]
        if len({own._layers for own in self.members}) > 1:
            raise ValueError("networks that choose together must have as many layers")
        self._all = _Together(self.members, heads=heads)

    @property
    def patch_numbers(self) -> int:
        """How many numbers each network takes for a patch."""
        return int(self.members[0]._weights["patch_1.weight"].shape[-1])

    def scores(self, choice: Choice) -> Floats:
        """Return the mean of the log-probabilities of each candidate ``(m,)``, of all networks and both views."""
        return np.asarray(_log_softmax(self._all.scores(choice)).mean(axis=(0, 1)))


class _Together(ChoiceNetwork):
    """Networks of one shape, their weights stacked, that look at once, and at the same time in a mirror."""

    def __init__(self, members: Sequence[ChoiceNetwork], *, heads: int) -> None:
        self._heads, self._layers = heads, members[0]._layers
        # (networks, 1: views, …)
        self._weights = {
            name: np.stack([own._weights[name] for own in members])[:, None] for name in members[0]._weights
        }

    def scores(self, choice: Choice) -> Floats:
        """Return what each network ``(networks, 2, m)`` holds of the choice, as it is and in a mirror."""
        views = choice, mirrored(choice)
        candidates, patches = np.stack([v.candidates for v in views]), np.stack([v.patches for v in views])
        return self._scores(candidates, patches, choice.distances, choice.state)


def joined(members: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    """Return the weights of several networks as :class:`ChoiceEnsemble` takes them; a single one's as they are."""
    if len(members) == 1:
        return dict(members[0])
    return {f"members.{k}.{name}": value for k, own in enumerate(members) for name, value in own.items()}


def apart(weights: Mapping[str, Floats]) -> list[dict[str, Floats]]:
    """Return the weights of each network of an ensemble, or of the only one."""
    count = len({name.split(".")[1] for name in weights if name.startswith("members.")})
    if count == 0:
        return [dict(weights)]
    starts = [f"members.{k}." for k in range(count)]
    return [{n.removeprefix(start): v for n, v in weights.items() if n.startswith(start)} for start in starts]


def _log_softmax(scores: Floats) -> Floats:
    above = scores - scores.max(axis=-1, keepdims=True)
    return np.asarray(above - np.log(np.exp(above).sum(axis=-1, keepdims=True)))

"""A trained policy as an agent: the network's weights beside a JSON file that says where they come from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agents.base import Goal
from agents.learned.choice import CANDIDATE, STATE
from agents.learned.choice_network import ChoiceEnsemble
from agents.learned.chooser import Chooser, ChooserConfig
from agents.learned.policy_files import read_policy
from slam.belief import Belief
from slam.settings import Config, Few, argument, checked, from_mapping, require
from slam.types import Floats

__all__ = ["FORMAT", "SHIPPED", "PpoFrontier", "PpoFrontierConfig", "load_choice_policy"]

FORMAT = "mecanum-slam choice policy 1"
SHIPPED = Path(__file__).parent / "policies" / "ppo-frontier.safetensors"


@dataclass(frozen=True, kw_only=True)
class PpoFrontierConfig(Config):
    """Which policy."""

    policy: str = ""  # path of a .safetensors file, the .json file beside it; the package's own by default
    driver: Mapping[str, Any] = field(default_factory=dict)  # laid over the ChooserConfig that it was trained with


def load_choice_policy(path: Path) -> tuple[ChoiceEnsemble, ChooserConfig, dict[str, Any]]:
    """Read a policy: its networks, the explorer it was trained with, and what the JSON file says of its training.

    See :func:`read_policy`.
    """
    (network, driver), described = read_policy(path, FORMAT, _made)
    return network, driver, described


def _made(weights: Mapping[str, Floats], described: Mapping[str, Any]) -> tuple[ChoiceEnsemble, ChooserConfig]:
    if [described.get("candidate"), described.get("state")] != [list(CANDIDATE), list(STATE)]:
        raise ValueError("it was trained on other columns than this version shows; train it anew")
    network = ChoiceEnsemble(weights, heads=checked("heads", Few, described["heads"]))
    driver = from_mapping(ChooserConfig, described["driver"])
    _check_patches(network, driver)
    return network, driver


def _check_patches(network: ChoiceEnsemble, driver: ChooserConfig) -> None:
    """Raise ``ValueError`` unless patches are as large as those that the networks were trained on."""
    side = math.isqrt(network.patch_numbers // 4)
    require(
        driver.choice.patch_cells == side,
        f"choice.patch_cells must be {side}, as it was trained with, got {driver.choice.patch_cells}",
    )


class PpoFrontier(Chooser):
    """Goes where a policy trained with PPO on ``mecanum_env/ExploreFrontier-v0`` says.

    Attributes
    ----------
    policy_path : Path
        The weights; what belongs to them lies beside, with the suffix ``.json``.
    about : dict
        What the policy's JSON file says of its training: command, configuration, steps, hours, curve.
    """

    def __init__(self, config: PpoFrontierConfig | Mapping[str, Any] | None = None, **body: Any) -> None:
        with argument("config"):
            settings = from_mapping(PpoFrontierConfig, config)
        self.policy_path = Path(settings.policy or SHIPPED)
        self._network, driver, self.about = load_choice_policy(self.policy_path)
        with argument("config.driver"):
            driver = from_mapping(ChooserConfig, settings.driver, base=driver)
            _check_patches(self._network, driver)
        super().__init__(driver, **body)

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point and the way there, or ``None`` when no frontier can be reached."""
        choice = self.survey(belief)
        if choice is not None:
            self.take(choice, int(np.argmax(self._network.scores(choice))))
        return super().choose(belief)

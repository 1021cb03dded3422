"""Policies that lie about themselves: one line that names the file."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from safetensors.numpy import load_file

import agents
from agents.learned.choice_network import ChoiceEnsemble, ChoiceNetwork, apart, joined
from agents.ppo import SHIPPED

POLICIES = SHIPPED.parent
PLANNING = {"goal_m": 8.0, "keep_m": 1.5, "stall_m": 4.0}


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    for suffix in (".safetensors", ".json"):
        shutil.copy(SHIPPED.with_suffix(suffix), tmp_path / f"mine{suffix}")
    return tmp_path / "mine.safetensors"


def refused(policy: Path, words: str = "policy") -> None:
    with pytest.raises(ValueError, match=words) as caught:
        agents.make(str(policy))
    text = str(caught.value)
    assert type(caught.value) is ValueError and text.isprintable() and len(text) < 600 and policy.stem in text


def test_a_sound_one_is_read(policy: Path) -> None:
    assert agents.make(str(policy)).about["format"] == agents.make("ppo").about["format"]


def test_weights_that_are_no_numbers_are_refused(policy: Path) -> None:
    sound = policy.read_bytes()
    begin = 8 + int.from_bytes(sound[:8], "little")
    for byte in (b"\xff", b"\x7c"):  # nan, and infinity
        policy.write_bytes(sound[:begin] + byte * (len(sound) - begin))
        refused(policy, "no finite number" if byte == b"\xff" else "policy")


def test_every_weight_that_choices_are_scored_with_has_to_be_there_and_to_fit() -> None:
    about = json.loads((POLICIES / "ppo-frontier.json").read_text())
    weights = apart(load_file(POLICIES / "ppo-frontier.safetensors"))[0]
    heads = int(about["heads"])
    ChoiceNetwork(weights, heads=heads)
    for name in weights:
        if not name.startswith("value_"):  # what a choice is worth is for training alone
            with pytest.raises(ValueError, match=rf"^weight {name} is missing"):
                ChoiceNetwork({other: w for other, w in weights.items() if other != name}, heads=heads)
            with pytest.raises(ValueError, match=r"^weight .* has the shape"):
                ChoiceNetwork(weights | {name: weights[name][..., None]}, heads=heads)


@pytest.mark.parametrize("kind", ["BF16", "F8_E4M3", "I64", "BOOL", "F64", "OBJECT", ""])
def test_weights_of_another_kind_are_refused(kind: str, policy: Path) -> None:
    tensor = {"dtype": kind, "shape": [1], "data_offsets": [0, 8]}
    header = json.dumps({"a": tensor}).encode()
    policy.write_bytes(len(header).to_bytes(8, "little") + header + bytes(8))
    refused(policy)


@pytest.mark.parametrize(
    "values",
    [
        {"planning": []}, {"planning": {"goal_m": [1]}}, {"planning": {"goal_m": 10**400}}, {"planning": None},
        {"planning": {}}, {"planning": PLANNING | {"goal_m": float("nan")}},
        {"planning": PLANNING | {"keep_m": -1.0}}, {"planning": PLANNING | {"stall_m": "4"}},
        {"planning": PLANNING | {"more": 1.0}},
        {"uncertainty": "no"}, {"uncertainty": None}, {"uncertainty": 1},
        {"format": "a\nb\x1b"}, {"format": "x" * 10_000}, {"format": []},
        {"format": "mecanum-slam station policy 2"}, {"format": "mecanum-slam choice policy 1"},
    ],
)  # fmt: skip
def test_descriptions_that_do_not_fit_are_refused(values: dict[str, object], policy: Path) -> None:
    about = policy.with_suffix(".json")
    about.write_text(json.dumps(json.loads(about.read_text()) | values))
    refused(policy)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"heads": 4.7}, "heads must be a whole number"), ({"heads": "4"}, "heads must be a whole number"),
        ({"heads": 5}, "heads 5 do not divide the width 64"),
        ({"driver": {"choice": {"patch_cells": 8}}}, "patch_cells must be 16, as it was trained with, got 8"),
    ],
)  # fmt: skip
def test_a_choice_policy_whose_description_is_of_other_networks_is_refused(
    values: dict[str, object], words: str, policy: Path
) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copy(POLICIES / f"ppo-frontier{suffix}", policy.with_suffix(suffix))
    about = policy.with_suffix(".json")
    about.write_text(json.dumps(json.loads(about.read_text()) | values))
    refused(policy, words)


def test_patches_of_another_size_than_it_was_trained_with_are_refused_before_the_first_choice() -> None:
    with pytest.raises(
        ValueError, match=r"^config\.driver: choice\.patch_cells must be 16, as it was trained with"
    ):
        agents.make("ppo-frontier", config={"driver": {"choice": {"patch_cells": 8}}})


def test_networks_that_choose_together_have_as_many_layers() -> None:
    weights = apart(load_file(POLICIES / "ppo-frontier.safetensors"))[0]
    heads = json.loads((POLICIES / "ppo-frontier.json").read_text())["heads"]
    fewer = {name: w for name, w in weights.items() if not name.startswith("layers.1.")}
    with pytest.raises(ValueError, match="as many layers"):
        ChoiceEnsemble(joined([fewer, weights]), heads=heads)


@pytest.mark.parametrize("text", [b"[" * 100_000, b"\xff", b"", b"9" * 5000])
def test_descriptions_that_are_no_json_are_refused(text: bytes, policy: Path) -> None:
    policy.with_suffix(".json").write_bytes(text)
    refused(policy)


def test_a_pipe_is_no_policy(policy: Path) -> None:
    policy.unlink()
    os.mkfifo(policy)
    refused(policy, "missing|not a file")

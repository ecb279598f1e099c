"""skill.py: an adapter finds its prior again, the mean of checkpoints by hand, and what cannot be played."""

import shutil
from pathlib import Path

import pytest
import torch

from kinetok.adapters import AdapterConfig, CoLAConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.adapters.rlft import TokenPolicyConfig
from kinetok.adapters.skill import Skill, mean_of
from kinetok.checkpoint import CheckpointError
from kinetok.config import ConfigError
from kinetok.gpt.controller import Prior
from kinetok.sim.tasks import TargetConfig

POLICY = TokenPolicyConfig(top_p=0.8, least=3)


PLAIN = LoRAConfig(rank=2)


def made(models: Path, adapter: AdapterConfig = PLAIN) -> Skill:
    """A skill that nobody trained."""
    torch.manual_seed(0)
    prior = Prior.from_pretrained(models / "prior")
    adapted = Adapted(prior.gpt, adapter, cond_dim=4)
    task = TargetConfig(distance=(1.0, 2.0))
    return Skill(adapted=adapted, prior=prior, base=str(models / "prior"), task=task, policy=POLICY)


def test_what_is_saved_is_found_again_with_its_prior(models, tmp_path):
    skill = made(models)
    skill.save_pretrained(tmp_path / "skill")
    back = Skill.from_pretrained(tmp_path / "skill")
    assert (back.task, back.policy) == (skill.task, POLICY)
    assert back.prior.gpt.norm.weight.equal(skill.prior.gpt.norm.weight)
    for name, tensor in skill.adapted.adapter_state().items():
        assert back.adapted.adapter_state()[name].equal(tensor)


def test_a_prior_that_has_moved_is_asked_for(models, tmp_path):
    made(models).save_pretrained(tmp_path / "skill")
    there = tmp_path / "deep" / "er" / "skill"
    shutil.copytree(tmp_path / "skill", there)
    with pytest.raises(CheckpointError, match=r"its prior is not at '.*prior'; give its place, --prior DIR"):
        Skill.from_pretrained(there)
    assert Skill.from_pretrained(there, models / "prior").policy == POLICY


def test_an_adapter_without_a_task_cannot_be_played(models, tmp_path):
    prior = Prior.from_pretrained(models / "prior")
    Adapted(prior.gpt, LoRAConfig(rank=1), 2).save_pretrained(tmp_path, base="prior")
    with pytest.raises(CheckpointError, match="says nothing of a task; it cannot be played"):
        Skill.from_pretrained(tmp_path)


def test_the_mean_of_checkpoints_by_hand(models):
    one, other = made(models), made(models)
    before = {name: tensor.clone() for name, tensor in one.adapted.adapter_state().items()}
    other.adapted.load_adapter_state_({name: tensor + 1.0 for name, tensor in before.items()})
    mean = mean_of([one, other, other])
    for name, tensor in mean.adapted.adapter_state().items():
        torch.testing.assert_close(tensor, before[name] + 2 / 3)
    for name, tensor in one.adapted.adapter_state().items():  # those it is made of are as they were
        assert tensor.equal(before[name])
    assert (mean.task, mean.policy) == (one.task, one.policy) and mean.prior is one.prior
    with pytest.raises(ConfigError, match=r"these adapters differ: kind: .*"):
        mean_of([one, made(models, CoLAConfig(rank=2))])

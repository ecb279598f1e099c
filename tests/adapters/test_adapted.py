"""adapted.py: the start is the base, what moves is the adapter, saving and loading, counts, merging."""

import copy
import json
import re
import warnings

import pytest
import torch

from kinetok.adapters import ADAPTERS, CoLAConfig, FullConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted, AdaptedConfig, fingerprint, parameters_at_paper_size, parameters_of
from kinetok.checkpoint import CheckpointError, save_artifact
from kinetok.config import ConfigError, from_dict, override, to_dict
from tests.adapters.bending import HEADS, KINDS, batch, bend, build, move

heads = pytest.mark.parametrize("head", HEADS)
kinds = pytest.mark.parametrize("kind", KINDS)


def decoded(model, start, tokens):
    """Logits (N, S, D, K) of a model, token after token with a cache."""
    cache, rows = model.new_cache(len(tokens)), []
    for j in range(tokens.shape[1]):
        h = model.begin(*start, cache) if j == 0 else model.advance(tokens[:, j - 1], cache)
        x, logits, digits = model.head.begin(h), [], getattr(model, "base", model).split(tokens[:, j])
        for d in range(model.head.choices):
            logits.append(model.head.logits(x, d))
            x = model.head.push(x, d, digits[:, d])
        rows.append(torch.stack(logits, 1))
    return torch.stack(rows, 1)


@kinds
@heads
@pytest.mark.parametrize("cond_dim", [0, 2])
def test_at_the_start_it_is_the_base(kind, head, cond_dim):
    adapted, (state, c, tokens) = bend(kind, head, cond_dim), batch(cond_dim=cond_dim)
    reference = adapted.base(state, tokens)
    torch.testing.assert_close(adapted(state, c, tokens), reference, rtol=0, atol=1e-6)
    in_steps = decoded(adapted.base, (state,), tokens)
    torch.testing.assert_close(decoded(adapted, (state, c), tokens), in_steps, rtol=0, atol=1e-6)
    if cond_dim == 0:
        torch.testing.assert_close(adapted(state, None, tokens), reference, rtol=0, atol=1e-6)


@kinds
@heads
def test_decoding_is_what_training_sees_and_disabled_it_is_the_base(kind, head):
    adapted, (state, c, tokens) = bend(kind, head, moved=True), batch()
    bent, reference = adapted(state, c, tokens), build(head)(state, tokens)
    assert (bent - reference).abs().max() > 0.1
    torch.testing.assert_close(decoded(adapted, (state, c), tokens), bent, rtol=1e-4, atol=2e-4)
    with adapted.disable():
        assert torch.equal(adapted(state, c, tokens), reference)
        torch.testing.assert_close(decoded(adapted, (state, c), tokens), reference, rtol=1e-4, atol=2e-4)
    assert torch.equal(adapted(state, c, tokens), bent)
    assert torch.equal(adapted.base(state, tokens), reference)


@kinds
def test_a_row_reads_its_own_condition_only(kind):
    adapted, (state, c, tokens) = bend(kind, moved=True), batch()
    changed = c.clone()
    changed[2] += 1.0
    moved = (adapted(state, changed, tokens) - adapted(state, c, tokens)).abs().amax((1, 2, 3))
    assert moved[2] > 1e-2 and (moved[[0, 1, 3, 4]] < 1e-5).all()


@kinds
@heads
def test_gradients_reach_every_adapter_parameter_and_no_other(kind, head):
    adapted, (state, c, tokens) = bend(kind, head, moved=True), batch()
    before = fingerprint(adapted.base)
    optimizer = torch.optim.Adam(adapted.trainable(), lr=1e-2)
    loss, metrics = adapted.loss(state, c, tokens)
    loss.backward()
    assert metrics["cross_entropy"] == loss.detach()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in adapted.trainable())
    assert all(p.grad is None for p in adapted.base.parameters())
    optimizer.step()
    assert fingerprint(adapted.base) == before


@kinds
def test_a_few_steps_from_the_start_fit_what_only_the_condition_tells(kind):
    adapted, (state, c, tokens) = bend(kind), batch(16)
    c = torch.where(torch.arange(16) < 8, 1.0, -1.0)[:, None] * torch.tensor([1.0, 0.5])
    state = state[:8].repeat(2, 1)  # each state twice, with other tokens under another condition
    optimizer = torch.optim.Adam(adapted.trainable(), lr=3e-2)
    first = adapted.loss(state, c, tokens)[0].item()
    for _ in range(25):
        optimizer.zero_grad()
        adapted.loss(state, c, tokens)[0].backward()
        optimizer.step()
    assert adapted.loss(state, c, tokens)[0] < 0.5 * first
    assert adapted.loss(state, -c, tokens)[0] > adapted.loss(state, c, tokens)[0] + 0.3


def test_the_condition_is_normalised_by_the_statistics_observed():
    adapted, (state, c, tokens) = bend("cola", moved=True), batch()
    plain = adapted(state, c, tokens)
    assert torch.equal(adapted(state, c, tokens), plain)  # forward moves no statistics
    adapted.observe(10.0 + 3.0 * torch.randn(500, 2))
    assert not torch.allclose(adapted(state, c, tokens), plain)


def test_dropout_acts_in_training_on_the_adapter_only():
    adapted, (state, c, tokens) = Adapted(build(), LoRAConfig(rank=3, dropout=0.5), 2), batch()
    move(adapted)
    assert torch.equal(adapted(state, c, tokens), adapted(state, c, tokens))
    adapted.train()
    assert not torch.equal(adapted(state, c, tokens), adapted(state, c, tokens))
    assert not adapted.base.training


@pytest.mark.parametrize(
    ("c", "message"),
    [
        (None, r"the task observation c is missing; it must be \(5, 2\)"),
        (torch.zeros(5, 3), r"has shape \(5, 3\); it must be \(5, 2\), \(N, cond_dim\)"),
        (torch.zeros(1, 2), r"has shape \(1, 2\)"),
    ],
)
def test_a_wrong_condition_is_refused(c, message):
    adapted, (state, _, tokens) = bend("cola"), batch()
    with pytest.raises(ValueError, match=message):
        adapted(state, c, tokens)
    with adapted.disable(), pytest.raises(ValueError, match=message):
        adapted(state, c, tokens)


@pytest.mark.parametrize("kind", ["lora", "cola"])
def test_nothing_reads_a_condition_of_an_earlier_call(kind):
    adapted, (state, c, tokens) = bend(kind), batch()
    cache = adapted.new_cache(5)
    adapted.begin(state, c, cache)
    adapted(state, c, tokens)
    with pytest.raises(ValueError, match="the condition is not set"):
        adapted.gpt(state, tokens)
    adapted.begin(state, c, cache)
    adapted.advance(tokens[:, 0], cache)


@kinds
@heads
def test_save_and_load(kind, head, tmp_path):
    adapted, (state, c, tokens) = bend(kind, head, moved=True), batch()
    adapted.save_pretrained(tmp_path, base="somewhere")
    assert {file.name for file in tmp_path.iterdir()} == {
        "adapter_config.json",
        "adapter_model.safetensors",
        "README.md",
    }
    loaded = Adapted.from_pretrained(tmp_path, build(head))
    assert loaded.config == KINDS[kind] and loaded.cond_dim == 2
    assert torch.equal(loaded(state, c, tokens), adapted(state, c, tokens))
    twin = copy.deepcopy(adapted)
    assert torch.equal(twin(state, c, tokens), adapted(state, c, tokens))
    assert twin.gpt.embed.weight is not adapted.gpt.embed.weight
    move(adapted).save_pretrained(tmp_path, base="somewhere", card="# Mine\n")  # replaces it
    assert (tmp_path / "README.md").read_text() == "# Mine\n"
    assert not torch.equal(Adapted.from_pretrained(tmp_path, build(head))(state, c, tokens), twin(state, c, tokens))


def test_a_low_rank_adapter_saves_nothing_of_the_base(tmp_path):
    adapted = bend("cola")
    names = adapted.adapter_state().keys()
    assert not any(".base." in name for name in names)
    assert sum(tensor.numel() for name, tensor in adapted.adapter_state().items() if "norm" not in name) == (
        parameters_of(adapted).trainable
    )


def test_another_base_is_refused_by_both_hashes(tmp_path):
    bend("lora").save_pretrained(tmp_path, base="somewhere")
    other = build(seed=1)
    mine, theirs = fingerprint(build())[:12], fingerprint(other)[:12]
    assert mine != theirs
    message = f"was made with the gpt {mine}, but priors/b is {theirs}; load the gpt it was made with"
    with pytest.raises(CheckpointError, match=re.escape(message)):
        Adapted.from_pretrained(tmp_path, other, base="priors/b")
    assert fingerprint(build("factorised")) != fingerprint(build())


def test_what_is_not_an_adapter_is_refused(tmp_path):
    save_artifact(tmp_path / "prior", kind="prior", config={}, tensors={"w": torch.ones(2)}, card="#")
    with pytest.raises(CheckpointError, match=r"holds a 'prior', which a 'adapter' would replace"):
        bend("lora").save_pretrained(tmp_path / "prior", base="prior")  # would overwrite the prior's card
    with pytest.raises(CheckpointError, match=r"has no adapter_config\.json"):
        Adapted.from_pretrained(tmp_path / "prior", build())
    adapted = bend("lora")
    state = adapted.adapter_state()
    (name, tensor), *_ = state.items()
    with pytest.raises(CheckpointError, match=f"the adapter lacks the tensor {name!r}"):
        adapted.load_adapter_state_({key: value for key, value in state.items() if key != name})
    with pytest.raises(CheckpointError, match=r"has no place for the tensor 'base_model\.model\.blocks\.7'"):
        adapted.load_adapter_state_(state | {"base_model.model.blocks.7": tensor})
    with pytest.raises(CheckpointError, match=re.escape(f"{name!r} of the adapter has shape (1,), not (3, 16)")):
        adapted.load_adapter_state_(state | {name: torch.ones(1)})


def test_configs_round_trip_and_are_told_apart_by_kind():
    for config in KINDS.values():
        whole = AdaptedConfig(adapter=config, cond_dim=3)
        assert from_dict(AdaptedConfig, json.loads(json.dumps(to_dict(whole)))) == whole
    whole = AdaptedConfig(adapter=LoRAConfig(), cond_dim=0)
    changed = override(whole, ["adapter.kind=cola", "adapter.rank=8", "adapter.targets=qkv,proj"])
    assert changed.adapter == CoLAConfig(rank=8, targets=("qkv", "proj"))
    with pytest.raises(ConfigError, match="did you mean 'cola'"):
        override(whole, ["adapter.kind=coka"])
    for kind, (config, _) in ADAPTERS.items():
        assert config().kind == kind


def test_unknown_targets_are_refused_when_built():
    with pytest.raises(ConfigError, match=r"no linear layer is called 'qvk'.*did you mean 'qkv'"):
        Adapted(build(), LoRAConfig(targets=("qvk",)), 2)
    with pytest.raises(ValueError, match="cond_dim >= 0, not -1"):
        Adapted(build(), LoRAConfig(), -1)


@pytest.mark.parametrize("kind", ["lora", "dora", "full"])
@heads
def test_merging(kind, head):
    adapted, (state, _, tokens) = bend(kind, head, cond_dim=0, moved=True), batch()
    plain = adapted.merge()
    assert [name for name, _ in plain.named_parameters()] == [name for name, _ in adapted.base.named_parameters()]
    torch.testing.assert_close(plain(state, tokens), adapted(state, None, tokens), rtol=1e-4, atol=2e-4)
    assert all(p is not q for p, q in zip(plain.parameters(), adapted.gpt.parameters(), strict=False))


def test_what_cannot_be_merged_is_refused():
    with pytest.raises(ValueError, match="nonlinear in its input"):
        bend("cola", cond_dim=0).merge()
    with pytest.raises(ValueError, match="reads a task observation of width 2, which a plain GPT does not take"):
        bend("dora").merge()


def test_counts():
    # Per block: qkv 16 x 48, proj 16 x 16, up 16 x 64, down 64 x 16: sums of sides 64, 32, 80, 80 = 256, rank 3,
    # two blocks: 1536. m: 48 + 16 + 64 + 16 = 144 per block. Token: 2 * 8 + 8 + 8 * 16 + 16 = 168.
    # FiLM: 2 * 8 + 8 + (8 + 1) * 8 layers * 2 * 3 = 456.
    base = sum(p.numel() for p in build().parameters())
    assert parameters_of(bend("lora"))[:2] == (1536 + 168, base)
    assert parameters_of(bend("lora", cond_dim=0))[:2] == (1536, base)
    assert parameters_of(bend("dora"))[:2] == (1536 + 288 + 168, base)
    assert parameters_of(bend("cola"))[:2] == (1536 + 288 + 456 + 168, base)
    assert parameters_of(bend("cola, film only"))[:2] == (1536 + 288 + 456, base)
    assert parameters_of(bend("full"))[:2] == (base + 168, base)
    assert parameters_of(bend("lora")).share == (1536 + 168) / base


def test_at_paper_size_only_one_layer_in_four_stays_below_one_percent():
    # Sides per block: qkv 4096, proj 2048, up 5120, down 5120; A and B of rank 64 in six blocks: 6,291,456.
    # m: 6 * (3072 + 1024 + 4096 + 1024); FiLM: 2 * 64 + 64 + 65 * 24 * 128; token: 192 + 65 * 1024.
    everywhere = parameters_at_paper_size(CoLAConfig())
    assert everywhere.trainable == 6_291_456 + 55_296 + 192 + 65 * 24 * 128 + 192 + 65 * 1024
    assert 0.04 < everywhere.share < 0.05
    assert parameters_at_paper_size(CoLAConfig(targets=("proj",))).share < 0.01
    assert parameters_at_paper_size(CoLAConfig(rank=8, alpha=16.0)).share < 0.01
    assert parameters_at_paper_size(FullConfig()).share > 1.0


def written(path):
    return json.loads((path / "adapter_config.json").read_text())


@pytest.mark.parametrize(
    ("kind", "cond_dim", "peft_type"),
    [
        ("lora", 0, "LORA"),
        ("dora", 0, "LORA"),
        ("lora", 2, "TASK_TOKEN_LORA"),  # peft would drop the task token
        ("cola", 0, "COLA"),
        ("full", 0, "FULL"),
    ],
)
def test_peft_type_names_what_peft_can_compute(kind, cond_dim, peft_type, tmp_path):
    bend(kind, cond_dim=cond_dim).save_pretrained(tmp_path, base="humanoid-gpt")
    config = written(tmp_path)
    assert config["peft_type"] == peft_type and config["base_model_name_or_path"] == "humanoid-gpt"
    if kind != "full":
        assert (config["r"], config["lora_alpha"], config["target_modules"][0]) == (3, 5.0, "blocks.0.qkv")
        assert config.get("use_dora", False) == (kind == "dora")


def test_a_lora_saved_is_the_update_that_peft_documents():
    adapted, (state, _, tokens) = bend("lora", cond_dim=0, moved=True), batch()
    tensors, by_hand = adapted.adapter_state(), build()
    assert len(tensors) == 2 * 8
    with torch.no_grad():
        for i in range(2):
            for end in ("qkv", "proj", "up", "down"):
                name = f"base_model.model.blocks.{i}.{end}"
                update = tensors[f"{name}.lora_B.weight"] @ tensors[f"{name}.lora_A.weight"]
                by_hand.get_submodule(f"blocks.{i}.{end}").weight.add_(5.0 / 3 * update)
    torch.testing.assert_close(by_hand(state, tokens), adapted(state, None, tokens), rtol=1e-4, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lora", "dora"])
@heads
def test_peft_opens_it_and_computes_the_same(kind, head, tmp_path):
    peft = pytest.importorskip("peft", reason="peft is not installed; it is the oracle of the saved format")
    adapted, (state, _, tokens) = bend(kind, head, cond_dim=0, moved=True), batch()
    adapted.save_pretrained(tmp_path, base="somewhere")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peft says that it ignores kinetok's own keys
        theirs = peft.PeftModel.from_pretrained(build(head), tmp_path)
    torch.testing.assert_close(theirs(state, tokens), adapted(state, None, tokens), rtol=1e-4, atol=2e-4)
    assert not torch.allclose(theirs(state, tokens), build(head)(state, tokens), atol=0.1)

"""Commands that train on tokens: `kinetok pretrain`, `kinetok finetune`."""

import click

from kinetok.cli.shared import PATHS, TASK_NAMES, configured, load_clips, option_hours


@click.command()
@click.option("--tokenizer", required=True, type=PATHS, help="Artifact directory or packaged name.")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@option_hours
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@configured("laptop")
def pretrain(tokenizer, paths, hours, out, preset, settings, threads, seed) -> None:
    """Train the prior: a GPT over the tokens of the frozen tracker's own roll-outs.

    \b
    Example: kinetok pretrain --tokenizer runs/walk --clips walk.txt --out runs/prior
    """
    from kinetok import presets
    from kinetok.config import override, pick
    from kinetok.gpt.pretrain import pretrain as train
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    config = override(pick(presets.PRETRAIN, preset, "preset")(), settings)
    train(
        MotionTokenizer.from_pretrained(tokenizer),
        load_clips(paths, hours, seed),
        config,
        out,
        tokenizer_path=tokenizer,
        seed=seed,
        threads=threads,
    )


@click.command()
@click.option("--prior", default=None, type=PATHS, help="Directory or packaged name.  [default: humanoid-gpt]")
@click.option("--task", default=None, metavar=TASK_NAMES, help="What to do.  [default: target, or that of --from]")
@click.option(
    "--adapter", default=None, metavar="cola|lora|dora|full", help="What bends it.  [default: cola, or that of --from]"
)
@click.option("--method", default="rl", show_default=True, help="Of sft,hindsight,rl, in this order.")
@click.option(
    "--clips", "paths", multiple=True, type=PATHS, help="Motions for sft and hindsight: file, library or folder."
)
@click.option("--from", "start", default=None, type=PATHS, help="A fine-tuned skill whose adapter rl begins with.")
@click.option(
    "--rebase", is_flag=True, default=False, help="Take the skill of --from over to --prior, another one of its shape."
)
@option_hours
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@configured("laptop")
def finetune(prior, task, adapter, method, paths, hours, start, rebase, out, preset, settings, threads, seed) -> None:
    """Bend the frozen prior to a task with a small adapter: by examples (sft), by demonstrations of the task that are
    made of --clips (hindsight), by reward (rl), or one after the other.

    \b
    Presets: laptop (an hour of two cores), gpu (for --device cuda), paper (GPC's sizes), tiny (tests).
    kinetok finetune --task target --method hindsight,rl --clips gaits.safetensors --out runs/target
    kinetok finetune --task steering --method sft,rl --clips zombie_walk.txt --out runs/zombie
    kinetok finetune --from runs/target --set task.distance=2,8 --out runs/further
    kinetok finetune --from runs/target --prior runs/newer --rebase --out runs/newer-target
    kinetok sample --adapter runs/target --out target.mp4
    Reward in four processes: torchrun --nproc-per-node 4 -m kinetok.cli finetune --from runs/target --out runs/further
    """
    from dataclasses import replace

    from kinetok import presets
    from kinetok.adapters.finetune import finetune as bend
    from kinetok.adapters.finetune import reshaped
    from kinetok.adapters.skill import Skill
    from kinetok.config import override, pick
    from kinetok.gpt.controller import Prior
    from kinetok.rl.ranks import joined

    config = pick(presets.FINETUNE, preset, "preset")()
    if start is None:
        base = prior or "humanoid-gpt"
        model = Prior.from_pretrained(base)
    else:
        skill = Skill.from_pretrained(start, prior, rebase=rebase)
        model, base = skill.prior, skill.base
        config = replace(config, task=skill.task, adapter=skill.adapted.config, policy=skill.policy)
    config = reshaped(config, task=task or config.task.kind, adapter=adapter or config.adapter.kind)
    config = override(replace(config, methods=tuple(method.split(","))), settings)
    clips = load_clips(paths, hours, seed)
    with joined():
        bend(model, config, out, base=base, clips=clips, start=start, rebase=rebase, seed=seed, threads=threads)

"""Numbers: `kinetok evaluate tracking|prior|task`."""

import click

from kinetok.cli.shared import (
    COUNT,
    PATHS,
    POSITIVE,
    PUSH,
    SECONDS,
    SHARE,
    TASK_NAMES,
    Chain,
    load_clips,
    option_device,
    option_hours,
    option_json,
    option_seed,
    option_threads,
    show_json,
)


@click.group(cls=Chain)
def evaluate() -> None:
    """Numbers with a seed: how well a tracker tracks, and how long a prior lives."""


@evaluate.command("tracking")
@click.option("--tokenizer", default="humanoid-fsq", show_default=True, type=PATHS, help="Directory or packaged name.")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@option_hours
@option_json
@click.option("--episodes", default=8, show_default=True, type=COUNT, help="Per clip, from phases spread over it.")
@click.option("--push", default=0.0, type=PUSH, help="Push the root every two seconds by so many m/s.")
@click.option(
    "--from-start",
    is_flag=True,
    default=False,
    show_default=True,
    help="Begin loops at their first frame alone, as papers do.",
)
@option_threads
@option_device
@option_seed
def evaluate_tracking(tokenizer, paths, hours, out, episodes, push, from_start, threads, seed) -> None:
    """Success rate and MPJPE of a tokenizer (or a teacher) on clips, by clip and overall."""
    from kinetok.evaluate import evaluate_tracking as score
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    model = MotionTokenizer.from_pretrained(tokenizer)
    found = score(
        model,
        load_clips(paths, hours, seed),
        episodes=episodes,
        push=push,
        from_start=from_start,
        threads=threads,
        seed=seed,
    )
    show_json(found, out)


@evaluate.command("prior")
@click.option("--prior", default="humanoid-gpt", show_default=True, type=PATHS, help="Directory or packaged name.")
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@option_json
@click.option("--episodes", default=64, show_default=True, type=COUNT, help="Motions to sample.")
@click.option(
    "--seconds", default=20.0, show_default=True, type=SECONDS, help="Length of each; who has fallen may get up."
)
@click.option("--push", default=0.0, type=PUSH, help="Push every character once, at step 200, by so many m/s.")
@click.option("--top-p", default=0.9, show_default=True, type=SHARE, help="Nucleus of the next-token distribution.")
@option_threads
@option_device
@option_seed
def evaluate_prior(prior, tokenizer, out, episodes, seconds, push, top_p, threads, seed) -> None:
    """Survival, diversity and smoothness of motion sampled from a prior, from random reference states."""
    from kinetok.evaluate import evaluate_prior as score
    from kinetok.gpt.controller import Prior

    model = Prior.from_pretrained(prior, tokenizer)
    show_json(score(model, episodes=episodes, seconds=seconds, push=push, top_p=top_p, threads=threads, seed=seed), out)


@evaluate.command("task")
@click.option("--adapter", default=None, type=PATHS, help="A fine-tuned skill; without it, the prior alone.")
@click.option(
    "--prior", default=None, type=PATHS, help="Its prior, if not at the place it notes; or which prior alone."
)
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@click.option("--task", default=None, metavar=TASK_NAMES, help="What to do.  [default: the skill's own; alone: target]")
@option_json
@click.option("--episodes", default=256, show_default=True, type=COUNT, help="Characters, each for --seconds.")
@click.option(
    "--seconds", default=20.0, show_default=True, type=SECONDS, help="Length of each; a target comes every 6 to 8 s."
)
@click.option("--push", default=0.0, type=PUSH, help="Push the root every two seconds by so many m/s.")
@click.option(
    "--top-p", default=None, type=SHARE, help="Nucleus of the next tokens.  [default: the skill's own; alone: 0.9]"
)
@click.option("--temperature", default=None, type=POSITIVE, help="Above 1 is bolder, below 1 more usual.  [default: 1]")
@option_threads
@option_device
@option_seed
def evaluate_task(
    adapter, prior, tokenizer, task, out, episodes, seconds, push, top_p, temperature, threads, seed
) -> None:
    """How well a skill does its task: success, final distance, errors, return and survival, as the task defines."""
    from kinetok.evaluate import evaluate_task as score

    told = {"episodes": episodes, "seconds": seconds, "push": push, "threads": threads, "seed": seed}
    told |= {"top_p": top_p, "temperature": temperature}
    show_json(score(adapter, prior, task, tokenizer=tokenizer, **told), out)

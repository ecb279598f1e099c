"""Fit a tokenizer in three stages, each also a function of its own and each resumable.

    fit(clips, FitConfig(), Path("runs/walk"), seed=0)

1. teacher    one continuous expert per clip, by PPO around the reference      out/teachers/NAME
2. distill    one student with the bottleneck learns from all of them online   out/distill
3. ppo        the student goes on end to end through the bottleneck            out/ppo

`stages=("ppo",)` trains end to end from nothing, the paper's form. The artifact in `out` itself is the best of
the student stages by the same evaluation, and its card says which stages made it. Teachers are independent, so
they train side by side, one core each; the result does not depend on how many do. At the end stands a table of how
well each clip is followed, by the tokenizer and by its teacher.
"""

import multiprocessing
import multiprocessing.connection
import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from kinetok.checkpoint import CheckpointError, load_artifact, load_state, locate, refuse_foreign, save_artifact
from kinetok.config import ConfigError, at_least, diff, nearest, to_dict
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.resume import refuse_changed
from kinetok.rl import ranks
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.rollout import torch_threads
from kinetok.rl.training import JUDGE, Progress
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.card import clip_table, tokenizer_card
from kinetok.tokenizers.distill import DistillStage, distill
from kinetok.tokenizers.quantizer import ContinuousConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer, TokenizerConfig
from kinetok.tokenizers.track import TrackingScore, track
from kinetok.tokenizers.train import (
    KINDS,
    PPOStage,
    good_enough,
    identify,
    in_scene,
    refuse_other_parents,
    train_ppo,
)

STAGES = ("teacher", "distill", "ppo")


def _teacher_tokenizer() -> TokenizerConfig:
    return TokenizerConfig(
        quantizer=ContinuousConfig(dim=64),
        future=(1, 2, 7),
        encoder=(256,),
        decoder=(128,),
        encoder_inputs=("window", "error"),
        decoder_inputs=(),
        residual=True,
    )


def _polish() -> PPOStage:
    return PPOStage(
        samples=1_000_000,
        critic_warmup=10,
        log_std=(-3.2, -3.2),
        anchor=0.02,
        env=EnvConfig(reset_noise=0.02, push=0.5),
        ppo=PPOConfig(lr=5e-5, lr_max=2e-4, target_kl=0.01),
    )


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """stages; tokenizer: the student; teacher_tokenizer: its experts; the three stages' own settings; mirror: the
    student learns every clip's mirror image too, from the same teacher; teacher_start: tokenizer (artifact directory or
    packaged name) whose weights every new teacher begins with, or a folder of such directories by the names of clips;
    teachers: tokenizer that teaches the student every clip, or such a folder, instead of those in `out`; start:
    tokenizer whose weights the student begins with; workers: teachers that train at once."""

    stages: tuple[str, ...] = STAGES
    tokenizer: TokenizerConfig = TokenizerConfig()
    teacher_tokenizer: TokenizerConfig = field(default_factory=_teacher_tokenizer)
    teacher: PPOStage = PPOStage(env=EnvConfig(reset_noise=0.02, push=0.5), stop_success=1.0, stop_mpjpe_mm=40.0)
    distill: DistillStage = DistillStage()
    ppo: PPOStage = field(default_factory=_polish)
    mirror: bool = False
    teacher_start: str = ""
    teachers: str = ""
    start: str = ""
    workers: int = 2

    def __post_init__(self) -> None:
        at_least(self, 1, {"workers": "1 trains one teacher after the other"})
        if not self.stages:
            raise ConfigError(f"stages is empty; name one or more of: {', '.join(STAGES)}")
        for stage in self.stages:
            if stage not in STAGES:
                raise ConfigError(f"unknown stage {stage!r}{nearest(stage, STAGES)}; stages: {', '.join(STAGES)}")
        for stage in (self.teacher, self.distill, self.ppo):
            in_scene(stage.env, self.tokenizer.scene)


def sizes_of(table: ReferenceTable, future: tuple[int, ...]) -> dict[str, int]:
    """Widths of the observation's parts for a future window."""
    layout = Tracking(TrackingConfig(future=future), table, rows=1).layout
    return {name: part.stop - part.start for name, part in layout.items()}


def new_tokenizer(config: TokenizerConfig, table: ReferenceTable, seed: int) -> MotionTokenizer:
    """A tokenizer with fresh weights whose actions start at the mean pose of the clips."""
    torch.manual_seed(seed)
    tokenizer = MotionTokenizer(config, sizes_of(table, config.future), table.character.nu)
    with torch.no_grad():
        tokenizer.action_mean.copy_(torch.as_tensor(table.target.mean(0)))
        tokenizer.action_scale.copy_(torch.as_tensor(table.target.std(0)).clamp_min(0.1))
    return tokenizer


def fit(
    clips: Sequence[Clip], config: FitConfig, out: Path | str, *, seed: int = 0, threads: int = 0
) -> MotionTokenizer:
    """Run the stages that are not finished yet and write the best tokenizer to `out`. Of the stages, `ppo` may be
    trained by several processes (rl/ranks.py)."""
    out = Path(out)
    with torch_threads(threads or torch.get_num_threads()):
        return _fit(clips, config, out, seed=seed, threads=threads)


def _fit(clips: Sequence[Clip], config: FitConfig, out: Path, *, seed: int, threads: int) -> MotionTokenizer:
    library = ClipLibrary.of(clips)
    if library.character != config.tokenizer.character:
        raise ConfigError(
            f"the clips are of {library.character!r}, tokenizer.character is {config.tokenizer.character!r}; "
            f"set tokenizer.character={library.character}"
        )
    names = [clip.name for clip in clips]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"two clips are named {twice!r}; rename a file, the name says which teacher is whose")
    images = [clip.mirror() for clip in clips] if config.mirror else []
    table = ReferenceTable(ClipLibrary.of([*clips, *images]), control_hz=config.tokenizer.scene.control_hz)
    student = new_tokenizer(config.tokenizer, table, seed)
    parents: dict[str, str] = {}
    if config.start:
        start = MotionTokenizer.from_pretrained(config.start)
        _refuse_other_shape(f"start {config.start}", config.tokenizer, start)
        student.load_state_dict(start.state_dict())
        parents = {"start": start.hash}
    if student.quantizer.levels:
        student.layout  # noqa: B018  refuses codes that do not divide into tokens, before hours of training
    teachers = _teachers(config, config.teachers, names) if config.teachers and "distill" in config.stages else []
    refuse_foreign(out, "tokenizer")
    _refuse_other_clips(out, table)
    out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    stories: dict[str, str] = {}
    scores: dict[str, TrackingScore] = {}
    if "teacher" in config.stages:
        train_teachers(clips, config, out / "teachers", seed=seed, threads=threads)
    story = ["start"] if config.start else []
    if "distill" in config.stages:
        teachers = teachers or _teachers(config, out / "teachers", names)
        parents |= {f"teacher/{name}": teacher.hash for name, teacher in zip(names, teachers, strict=True)}
        story += ["teacher", "distill"]
        stories["distill"] = " -> ".join(story)
        scores["distill"] = distill(
            student,
            teachers * 2 if images else teachers,
            table,
            config.distill,
            out / "distill",
            seed=seed,
            threads=threads,
            card=lambda score: tokenizer_card(student, table.names, stories["distill"], seed, score),
            mirrored=[False] * len(clips) + [True] * len(images),
            parents=parents,
        )
        parents = {"distill": load_artifact(out / "distill").hash} | parents
    if "ppo" in config.stages:
        story.append("ppo")
        stories["ppo"] = " -> ".join(story)
        scores["ppo"] = train_ppo(
            student,
            table,
            config.ppo,
            out / "ppo",
            seed=seed,
            threads=threads,
            title="ppo through the bottleneck",
            card=lambda score: tokenizer_card(student, table.names, stories["ppo"], seed, score, config.ppo.eval_push),
            parents=parents,
        )
    taught = _taught_numbers(out / "teachers", table.names, len(names))
    if not stories:
        Console().print(clip_table(names, {"teacher": taught[: len(names)]}))
        return MotionTokenizer.from_pretrained(out / "teachers" / names[0])
    if len(scores) > 1:  # by the same episodes, those of the last stage's evaluations
        scores = {stage: _judged(out / stage, config, table, seed, threads) for stage in scores}
    push = config.ppo.eval_push if "ppo" in scores else 0.0
    best = max(scores, key=lambda stage: scores[stage].merit)
    told = {"story": stories[best], "seed": seed, "push": push}
    ranks.first(lambda: _publish(out, best, scores[best], taught, started, **told))
    return MotionTokenizer.from_pretrained(out)


def _refuse_other_clips(out: Path, table: ReferenceTable) -> None:
    """Refuse a run of other clips before its first stage, which would add to it what a later one then refuses."""
    for stage in ("distill", "ppo"):
        if (path := out / stage / "state.safetensors").exists():
            before = load_state(path)[1].get("identity", {})
            if changed := diff({key: before.get(key) for key in table.identity}, table.identity):
                raise CheckpointError(
                    f"{path}: this run is of other clips: {'; '.join(changed)}. "
                    "Give the same clips to go on, or choose another --out"
                )


def _judged(place: Path, config: FitConfig, table: ReferenceTable, seed: int, threads: int) -> TrackingScore:
    """What the artifact of a stage does in the evaluation of the stage `ppo`."""
    stage, tokenizer = config.ppo, config.tokenizer
    return track(
        MotionTokenizer.from_pretrained(place),
        table,
        future=tokenizer.future,
        scene=tokenizer.scene,
        episodes=stage.eval_episodes,
        push=stage.eval_push,
        threads=threads,
        seed=seed + JUDGE,
    )


def _publish(
    out: Path,
    best: str,
    score: TrackingScore,
    taught: np.ndarray,
    started: float,
    *,
    story: str,
    seed: int,
    push: float,
) -> None:
    """Copy the best stage's artifact to `out`, and show how well it follows each clip."""
    artifact, tokenizer = load_artifact(out / best), MotionTokenizer.from_pretrained(out / best)
    save_artifact(
        out,
        kind=artifact.kind,
        config=artifact.config,
        tensors=artifact.tensors,
        card=tokenizer_card(tokenizer, score.names, story, seed, score, push),
        parents=artifact.parents,
    )
    found = {best: np.stack([score.success, score.mpjpe_mm], axis=1)}
    Console().print(clip_table(score.names, found if np.isnan(taught).all() else found | {"teacher": taught}))
    told = (
        f"success {score.success.mean():.0%} (mean form {score.success_mean_error.mean():.0%}), MPJPE "
        f"{score.mpjpe_mm.mean():.0f} mm, {score.mpjpe_local_mm.mean():.0f} from the root"
    )
    print(f"best stage: {best}; {told}; {(time.monotonic() - started) / 60:.1f} min; {out}")


def _taught_numbers(folder: Path, names: Sequence[str], teachers: int) -> np.ndarray:
    """Success and MPJPE in mm (K, 2) of each clip's teacher as its training left it; mirror images follow the clips."""
    numbers = np.full((len(names), 2), np.nan)
    for k in range(len(names)):
        state = folder / names[k % teachers] / "state.safetensors"
        if state.exists() and (score := load_state(state)[1]["progress"].get("score")):
            numbers[k] = score["success"][0], score["mpjpe_mm"][0]
    return numbers


def train_teachers(clips: Sequence[Clip], config: FitConfig, out: Path, *, seed: int, threads: int) -> None:
    """One expert per clip, `config.workers` at a time on one core each; finished ones are left alone."""
    ranks.alone("a teacher for each clip")
    jobs = [
        (clip, _others(clip, clips, config), config, out / clip.name, seed)
        for clip in clips
        if not _taught(clip, _others(clip, clips, config), config, out / clip.name, seed)
    ]
    if len(jobs) <= 1 or config.workers <= 1:
        # Sums of a network depend on its threads: one for each of many teachers, as in the pool.
        with torch_threads(torch.get_num_threads() if len(clips) == 1 else 1):
            for job in jobs:
                _teach(*job, threads=threads, quiet=False)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(config.workers, context, begin_worker, (str(torch.get_default_device()),)) as pool:
        running = {pool.submit(_teach, *job, threads=1, quiet=True): job[0].name for job in jobs}
        try:
            _report(running, len(jobs))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _others(clip: Clip, clips: Sequence[Clip], config: FitConfig) -> list[Clip]:
    """Every other clip, and with `mirror` every mirror image."""
    return [other for other in clips if other is not clip] + [other.mirror() for other in clips if config.mirror]


def begin_worker(device: str = "cpu") -> None:
    """The parent's default device and one thread for the sums of networks, and an end as soon as the parent has ended,
    by a signal or otherwise."""
    torch.set_num_threads(1)
    torch.set_default_device(device)
    parent = multiprocessing.parent_process()
    assert parent is not None  # this runs in a pool's process

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _report(running: dict, total: int) -> None:
    """Wait for teachers and say how each did; the first error stops the rest from starting."""
    for count, future in enumerate(as_completed(running), 1):
        print(f"teacher {count}/{total} {running[future]}: {future.result()}", flush=True)


def _taught(clip: Clip, others: Sequence[Clip], config: FitConfig, out: Path, seed: int) -> bool:
    """Whether the teacher in `out` is finished; refuses one that was trained otherwise."""
    state = out / "state.safetensors"
    if not state.exists():
        return False
    meta = load_state(state)[1]
    parents = _start(config, clip.name)[1]
    refuse_other_parents(state, parents)
    identity = identify(config.teacher, _settings(config), ClipLibrary.of([clip]).identity(), seed)
    identity |= {"parents": parents} if parents else {}
    identity |= {"others": ClipLibrary.of(others or [clip]).identity()} if config.teacher.arrivals else {}
    refuse_changed(state, meta["identity"], identity, KINDS | {"stage": PPOStage})
    progress = Progress(**meta["progress"])
    return progress.samples >= config.teacher.samples or good_enough(progress, config.teacher)


def _settings(config: FitConfig) -> TokenizerConfig:
    """The teachers' own, in the student's body and physics."""
    return replace(config.teacher_tokenizer, character=config.tokenizer.character, scene=config.tokenizer.scene)


def _place_of(setting: str, path: str, name: str) -> Path:
    """The tokenizer at `path`, by directory or packaged name, or that of clip `name` in the folder there."""
    place = locate(path)
    if (place / "config.json").exists():
        return place
    if not place.is_dir():
        raise ConfigError(
            f"{setting} {path}: no such directory; give a tokenizer's, or a folder of them by clips' names"
        )
    return place / name


def _start(config: FitConfig, name: str) -> tuple[MotionTokenizer | None, dict[str, str]]:
    """The teacher that the one of clip `name` begins with, and its hash by role; nothing where there is none."""
    if not config.teacher_start:
        return None, {}
    path = _place_of("teacher_start", config.teacher_start, name)
    if not path.exists():
        return None, {}
    start = MotionTokenizer.from_pretrained(path)
    _refuse_other_shape(f"teacher_start {path}", _settings(config), start)
    return start, {"start": start.hash}


def _refuse_other_shape(what: str, wanted: TokenizerConfig, found: MotionTokenizer) -> None:
    changed = diff(to_dict(wanted), to_dict(found.config))
    if changed:
        raise ConfigError(f"{what} is of another shape: {'; '.join(changed)}")


def _teachers(config: FitConfig, place: Path | str, names: Sequence[str]) -> list[MotionTokenizer]:
    """Who teaches each of the clips: the tokenizer at `place`, or those in that folder. What one of them knows holds in
    its own body, physics and control rate."""
    places = [_place_of("teachers", str(place), name) for name in names]
    known = {place: MotionTokenizer.from_pretrained(place) for place in dict.fromkeys(places)}
    for place, teacher in known.items():
        there, here = (
            {"character": shape.character, "scene": to_dict(shape.scene)}
            for shape in (teacher.config, config.tokenizer)
        )
        if changed := diff(there, here):
            raise ConfigError(
                f"teacher {place} moves another body or in other physics than tokenizer says: {'; '.join(changed)}; "
                "set tokenizer.* as it has them, or take another teacher"
            )
    same = {teacher.hash: teacher for teacher in known.values()}  # links and copies are labelled together
    return [same[known[place].hash] for place in places]


def _teach(
    clip: Clip, others: Sequence[Clip], config: FitConfig, out: Path, seed: int, *, threads: int, quiet: bool
) -> str:
    """Train the teacher of one clip. others: clips that it may have to go on from."""
    settings = _settings(config)
    table = ReferenceTable(ClipLibrary.of([clip]), control_hz=settings.scene.control_hz)
    origins = None
    if config.teacher.arrivals and others:
        origins = ReferenceTable(ClipLibrary.of(others), control_hz=settings.scene.control_hz)
    teacher, (start, parents) = new_tokenizer(settings, table, seed), _start(config, clip.name)
    if start is not None:
        teacher.load_state_dict(start.state_dict())
    score = train_ppo(
        teacher,
        table,
        config.teacher,
        out,
        seed=seed,
        threads=threads,
        title=f"teacher {clip.name}",
        card=lambda score: tokenizer_card(teacher, [clip.name], "teacher", seed, score, config.teacher.eval_push),
        parents=parents,
        others=origins,
        quiet=quiet,
    )
    return f"success {score.success.mean():.2f}, {score.mpjpe_mm.mean():.0f} mm"

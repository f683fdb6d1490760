"""How each command is called in tests: short, on runs that were made by hand."""

from pathlib import Path

from tests.experiments.test_evidence import scores
from tests.experiments.test_report import make_run as make_described_run

FAST = ["--episodes", "1"]
#: {real}: a run with a model; {other}: another one; {run}: one without; {runs}: several; {out}: a fresh folder
CASES: dict[str, list[str]] = {
    "compare": ["--task", "cartpole-swingup", "--presets", "rad", "--seeds", "1", "-o", "{out}", "--dry-run"],
    "sweep": ["{sweep}", "-o", "{out}", "--dry-run"],
    "watch": ["{runs}"],
    "evaluate": ["{run}"],
    "table": ["100k", "{runs}"],
    "curves": ["{csv}", "-o", "{out}"],
    "curve": ["{run}", "--output", "{out}/curve.png", "--baselines", "{baselines}"],
    "report": ["{runs}", "-o", "{out}/report.html"],
    "latents": ["{real}", *FAST, "--decisions", "20", "-o", "{out}"],
    "tsne": ["{real}", *FAST, "--decisions", "60", "--clusters", "2", "--neighbours", "3", "-o", "{out}"],
    "correlate": ["{real}", "{other}", *FAST, "--decisions", "60", "--states", "40", "-o", "{out}"],
    "probe": ["{real}", *FAST, "--decisions", "60", "--states", "40", "-o", "{out}"],
    "film": ["{real}", *FAST, "--decisions", "20", "-o", "{out}"],
    "generalize": ["{real}", *FAST, "--modes", "none", "-o", "{out}"],
    "export": ["{real}", "{out}/policy.sb3crc"],
    "push": ["{real}", "--repo-id", "me/it", "--no-film", "-o", "{out}/page"],
    "enjoy": ["{policy}", *FAST],
    "baselines": ["pendulum-swingup", "--episodes", "2", "--action-repeat", "100"],
    "landmarks": ["--task", "cartpole-swingup", "--episodes", "1", "-o", "{out}/landmarks.json"],
    "ladder": ["probe", "--config", "{config}"],
    "contact-sheet": [
        "--tasks", "cartpole-swingup", "--modes", "color_hard", "--render-quality", "fast", "-o", "{out}/s.png"
    ],
    "trials": ["{run}", "--episodes", "0", "--output", "{out}/trials.csv"],
    "results": ["{csv}", "--landmarks", "{landmarks}", "--trials", "{trials}", "-o", "{out}/results.md"],
    "reproduced": ["{csv}", "{csv}"],
    "doctor": [],
    "rendering": [],
}  # fmt: skip


def make_places(folder: Path) -> dict[str, Path]:
    """What the cases name, but for real runs."""
    run = make_described_run(folder / "runs", "crc")
    make_described_run(folder / "runs", "rad", 1, ended=False)
    (run / "0.monitor.csv").write_text("#{}\nr,l,t\n800,125,60\n")
    places = {name: folder / name for name in ("sweep", "config", "baselines", "landmarks", "trials")}
    places["sweep"].write_text("env_steps: 100000\ntasks: [cartpole-swingup]\nseeds: 1\nvariants: {rad: {}}\n")
    encoder = "{channels: [8, 8], strides: [2, 2], features_dim: 16}"
    places["config"].write_text(f"default: {{policy_kwargs: {{features_extractor_kwargs: {encoder}}}}}\n")
    places["baselines"].write_text('{"random": {"mean": 30.0}}')
    places["landmarks"].write_text('{"returns": {"cartpole-swingup": {"random": [30.0]}}}')
    places["trials"].write_text("algo\nrad\n")
    return places | {"run": run, "runs": folder / "runs", "csv": scores(folder / "scores.csv", "rad", {0: 700, 1: 800})}

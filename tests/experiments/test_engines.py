"""Engines: what they refuse, and real trainings on two Ray nodes, one of which is killed, and in jobs that are preempted."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psutil
import pytest
import submitit  # noqa: F401  # now: it sets logging up, and absl would then close the stderr that a test has in place
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.engines.execution import SETTINGS, InUse, RunProcess, finished, plan
from sb3_crc.experiments.engines.keeping import Keeper
from sb3_crc.experiments.engines.local import Stopped, run_locally
from sb3_crc.experiments.engines.ray_cluster import RayOptions, connect, run_on_ray
from sb3_crc.experiments.engines.slurm import JOB, SlurmOptions, run_on_slurm
from sb3_crc.experiments.runs import FAILURE, SPEC, read_json
from sb3_crc.experiments.specs import RunSpec, compared
from tests.experiments.test_compare import results
from tests.test_zoo import ROOT

TINY = ROOT / "tests" / "tiny.yml"
Events = list[tuple[str, str]]


def specs(*presets: str, env_steps: int = 1200, **own: Any) -> list[RunSpec]:
    protocol = {"env_steps": env_steps, "eval_every": 400, "eval_episodes": 1, "conf_file": TINY} | own
    return compared(presets or ["rad"], ["cartpole-swingup"], [0], **protocol)


def collector() -> tuple[Events, Callable[[RunSpec, str, str], None]]:
    events: Events = []
    return events, lambda spec, event, remark: events.append((event, f"{spec.method} {remark}".strip()))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--engine", "rai"], "unknown --engine 'rai'; did you mean 'ray'?"),
        (["--address", "auto"], "--address is an option of --engine ray; this is --engine local"),
        (["--engine", "ray", "--jobs", "2"], "--jobs is an option of --engine local and slurm"),
        (["--engine", "slurm", "--gpus", "0.5"], "Slurm gives whole GPUs"),
        (["--engine", "slurm", "--slurm", "partition"], "--slurm 'partition' must be NAME=VALUE"),
        (["--engine", "slurm", "--slurm", "timeout_min=4h"], "--slurm timeout_min=4h must be a whole number of minutes"),
        (["--engine", "slurm", "--memory", "1"], "sbatch is not in PATH"),
        (["--engine", "slurm", "--memory", "1", "--slurm", "cluster=local", "--slurm", "colour=red"], "colour"),
        (["--engine", "ray", "--address", "nowhere", "--memory", "1"], "'nowhere' is no address"),
        (["--output", str(TINY / "below"), "--jobs", "1"], "nothing can be written to"),
        (["--output", "/proc/runs", "--jobs", "1"], "nothing can be written to /proc/runs"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, flags: list[str], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # no Slurm
    own = ["--task", "cartpole-swingup", "--presets", "rad", "--seeds", "1", "--env-steps", "1200", "--eval-every", "400"]
    own += ["--conf-file", str(TINY)]
    done = CliRunner().invoke(app, ["compare", *own, "--output", str(tmp_path / "runs"), *flags])
    assert done.exit_code == 2 and message in done.stderr and "Traceback" not in done.stderr, done.stderr
    assert not list(tmp_path.rglob(FAILURE))


def test_an_address_at_which_nothing_answers() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        began = time.monotonic()
        with pytest.raises(ValueError, match=f"no Ray cluster answers at {address}"):
            connect(address)
        assert time.monotonic() - began < 10


def test_a_half_written_description_is_written_anew(tmp_path: Path) -> None:
    (spec,) = specs()
    plan([spec], tmp_path)
    folder = tmp_path / spec.name
    whole = (folder / SPEC).read_text()
    (folder / SPEC).write_text(whole[:40])
    (folder / SETTINGS).unlink()
    assert plan([spec], tmp_path) == [spec]
    assert (folder / SPEC).read_text() == whole and (folder / SETTINGS).exists() and read_json(folder / SPEC) == asdict(spec)


def test_only_one_command_works_on_a_run(tmp_path: Path) -> None:
    (spec,) = plan(specs(), tmp_path)
    first, second = (RunProcess(spec, tmp_path, checkpoint_every=1_000, threads=1) for _ in range(2))
    first.start()
    try:
        with pytest.raises(InUse, match=f"{tmp_path / spec.name} is in use"):
            second.start()
        events, report = collector()
        assert run_locally([spec], tmp_path, report=report) == [spec]
        assert events[0][0] == "skipped" and not (tmp_path / spec.name / FAILURE).exists()
    finally:
        first.ask_to_stop()
        first.wait_until_stopped(time.monotonic() + 60)
    second.start()
    second.ask_to_stop()
    second.wait_until_stopped(time.monotonic() + 60)


def test_a_run_that_ended_before_its_first_checkpoint_begins_anew(tmp_path: Path) -> None:
    (spec,) = plan(specs(), tmp_path)
    half_written = (
        tmp_path / spec.name / "rad" / "dmc_pixels-cartpole-swingup-v0_1" / "dmc_pixels-cartpole-swingup-v0" / "args.yml"
    )
    half_written.parent.mkdir(parents=True)
    half_written.write_text("!!python/object/apply:collections.Ord")
    events, report = collector()
    run = RunProcess(spec, tmp_path, checkpoint_every=1_000, threads=1, report=report)
    run.start()
    run.ask_to_stop()
    run.wait_until_stopped(time.monotonic() + 60)
    assert events == [("begun", "rad")] and not half_written.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_a_training_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    (spec,) = plan(specs(), tmp_path)
    script = (
        "import json, sys\nfrom pathlib import Path\n"
        "from sb3_crc.experiments.engines.execution import RunProcess\nfrom sb3_crc.experiments.specs import RunSpec\n"
        f"run = RunProcess(RunSpec(**json.loads(sys.stdin.read())), Path({str(tmp_path)!r}), checkpoint_every=25, threads=1)\n"
        "run.start()\nprint(run._process.pid, flush=True)\nimport time\ntime.sleep(60)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdin is not None and parent.stdout is not None
    parent.stdin.write((tmp_path / spec.name / SPEC).read_text())
    parent.stdin.close()
    training = psutil.Process(int(parent.stdout.readline()))
    parent.kill()
    parent.wait()
    training.wait(30)  # raises if it is still there
    parent.stdout.close()


def test_the_keeper_writes_nowhere_else(tmp_path: Path) -> None:
    keeper = Keeper(str(tmp_path / "runs"))
    keeper.write("a/b", "c/file", b"1")
    assert keeper.names("a/b") == ["c/file"] and keeper.read("a/b", "c/file") == b"1"
    for name in ("../../../file", "/tmp/file"):
        with pytest.raises(ValueError, match="is no file in"):
            keeper.write("a/b", name, b"1")
    keeper.remove("a/b", ["c/file"])
    assert not (tmp_path / "runs" / "a" / "b" / "c").exists()


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    root = tmp_path_factory.mktemp("uninterrupted")
    os.environ["OMP_NUM_THREADS"] = "1"
    assert run_locally(specs("crc", "rad", "curl"), root, jobs=2, checkpoint_every=25) == []
    return results(root)


@pytest.fixture
def cluster() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        yield found
    finally:
        found.shutdown()


def node_of(spec: RunSpec, nodes: list[Any]) -> Any:
    """:return: the node on which a run is training; None: it trains on none of them"""
    for process in psutil.process_iter(["cmdline"]):
        if "train" in (command := process.info["cmdline"] or []) and any(spec.name in part for part in command):
            with suppress(psutil.NoSuchProcess):
                ancestors = {parent.pid for parent in process.parents()}
                for node in nodes:
                    if node.all_processes["raylet"][0].process.pid in ancestors:
                        return node
    return None


@pytest.mark.slow
@pytest.mark.parametrize("shared", [None, False], ids=["shared folder", "object store"])
def test_a_node_that_dies_loses_nothing(
    tmp_path: Path, cluster: Any, uninterrupted: dict[str, Any], shared: bool | None
) -> None:
    nodes = [cluster.add_node(num_cpus=1, num_gpus=1), cluster.add_node(num_cpus=1, num_gpus=1)]
    runs = specs("crc", "rad", "curl")
    stopped = threading.Event()

    def kill_one() -> None:
        """Kill a node in the middle of a run that has a checkpoint."""
        while not stopped.wait(0.1):
            for spec in runs:
                begun = any((tmp_path / spec.name).rglob("checkpoints/0*/manifest.json"))
                node = node_of(spec, nodes) if begun and not finished(tmp_path / spec.name) else None
                if node is not None:
                    cluster.remove_node(node, allow_graceful=False)
                    return

    killer = threading.Thread(target=kill_one)
    killer.start()
    events, report = collector()
    try:
        failed = run_on_ray(
            runs,
            tmp_path,
            RayOptions(cluster.address, gpus=0.5, memory=10**8, shared=shared, keep_every=0.1),
            checkpoint_every=25,
            report=report,
        )
    finally:
        stopped.set()
        killer.join()
    assert failed == [] and sum(event == "finished" for event, _ in events) == 3
    assert any(event == "resumed" for event, _ in events)
    assert results(tmp_path) == uninterrupted
    assert run_on_ray(runs, tmp_path, RayOptions("127.0.0.1:1")) == []  # nothing is left to do: nothing is asked


@pytest.mark.slow
def test_failures_on_ray_do_not_stop_the_others(tmp_path: Path) -> None:
    broken = compared(["crc"], ["cartpole-swingup"], [1], env_steps=1200, eval_every=400, eval_episodes=1, conf_file=TINY)[0]
    broken = RunSpec(**{**asdict(broken), "settings": {**broken.settings, "augmentation": "mirror"}})
    events, report = collector()
    assert run_on_ray([broken, *specs()], tmp_path, RayOptions(), checkpoint_every=25, report=report) == [broken]
    assert any(event == "failed" and "mirror" in remark for event, remark in events)
    assert set(results(tmp_path)) == {"rad"}


@pytest.mark.slow
def test_a_job_that_is_preempted_goes_on(tmp_path: Path, uninterrupted: dict[str, Any]) -> None:
    (spec, other) = specs("crc", "rad")
    stopped = threading.Event()

    def preempt_one() -> None:
        while not stopped.wait(0.1):
            if list((tmp_path / spec.name).rglob("checkpoints/0*/manifest.json")):
                controller = psutil.Process(int(read_json(tmp_path / spec.name / JOB)["job_id"]))
                controller.children()[0].send_signal(signal.SIGUSR2)
                return

    killer = threading.Thread(target=preempt_one)
    killer.start()
    events, report = collector()
    try:
        failed = run_on_slurm(
            [spec, other], tmp_path, SlurmOptions(cluster="local", minutes=60), checkpoint_every=25, report=report
        )
    finally:
        stopped.set()
        killer.join()
    assert failed == [] and finished(tmp_path / spec.name)
    assert ("resumed", "crc") in events and ("resumed", "rad") not in events
    assert results(tmp_path) == {method: uninterrupted[method] for method in ("crc", "rad")}


@pytest.mark.slow
def test_a_job_that_is_killed_is_submitted_again(tmp_path: Path, uninterrupted: dict[str, Any]) -> None:
    (spec,) = specs("rad")
    stopped = threading.Event()

    def kill() -> None:
        while not stopped.wait(0.1):
            if list((tmp_path / spec.name).rglob("checkpoints/0*/manifest.json")):
                controller = psutil.Process(int(read_json(tmp_path / spec.name / JOB)["job_id"]))
                for process in [controller, *controller.children()]:
                    process.kill()
                return

    killer = threading.Thread(target=kill)
    killer.start()
    events, report = collector()
    try:
        failed = run_on_slurm([spec], tmp_path, SlurmOptions(cluster="local", minutes=60), checkpoint_every=25, report=report)
    finally:
        stopped.set()
        killer.join()
    assert failed == [] and sum(event == "submitted" for event, _ in events) == 2
    assert results(tmp_path) == {"rad": uninterrupted["rad"]}


FAKE_SLURM = {
    # runs the script behind it, as a job that outlives its submission
    "sbatch": """
import os, re, subprocess, sys
script = open(sys.argv[-1]).read()
open("{folder}/script", "w").write(script)
size = int((re.search(r"#SBATCH --array=0-(\\d+)", script) or re.search("()", "")).group(1) or -1) + 1
for task in range(max(1, size)):
    job = {{"SLURM_JOB_ID": f"7{{task}}", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": str(task)}}
    job |= {{"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_NODEID": "0", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}}
    process = subprocess.Popen(["bash", sys.argv[-1]], env=os.environ | job, start_new_session=True, stdout=-3, stderr=-3)
    open(f"{folder}/7_{{task}}", "w").write(str(process.pid))
print("Submitted batch job 7")
""",
    "srun": """
import os, sys
command = sys.argv[1:]
os.execvp(command[command.index("-u") - 1], command[command.index("-u") - 1 :])
""",
    "sacct": """
import glob, os
print("JobID|State|NodeList")
for path in glob.glob("{folder}/7_*"):
    alive = os.path.exists(f"/proc/{{open(path).read()}}")
    print(f"{{os.path.basename(path)}}|{{'RUNNING' if alive else 'COMPLETED'}}|here")
""",
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Slurm is played by scripts that read /proc")
def test_the_same_command_finds_its_jobs_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uninterrupted: dict[str, Any]
) -> None:
    """Slurm itself is played by three scripts; submitit's side of it is real."""
    for name, text in FAKE_SLURM.items():
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(f"#!{sys.executable}{text.format(folder=tmp_path)}")
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    runs, root = specs("crc", "rad"), tmp_path / "runs"
    options = SlurmOptions(minutes=60, cpus=1, gpus=0, memory=2 << 30, at_once=2, parameters={"partition": "short"})
    events, report = collector()

    def interrupt() -> None:
        while not list(root.rglob("checkpoints/0*/manifest.json")):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(Stopped):
        run_on_slurm(runs, root, options, checkpoint_every=25, report=report)
    assert [event for event, _ in events] == ["submitted", "submitted"]
    script = (tmp_path / "script").read_text()
    for line in ("--array=0-1%2", "--partition=short", "--cpus-per-task=1", "--mem=2GB", "--time=60", "--signal=USR2@120"):
        assert f"#SBATCH {line}" in script, script

    assert run_on_slurm(runs, root, options, checkpoint_every=25, report=report) == []
    found = [remark for event, remark in events if event == "found"]
    assert found and sum(event == "submitted" for event, _ in events) == 2  # none was submitted again
    assert sum(event == "finished" for event, _ in events) == len(found)
    assert results(root) == {method: uninterrupted[method] for method in ("crc", "rad")}

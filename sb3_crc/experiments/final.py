"""The score of a run: its final policy, after exactly its budget, on fresh episodes."""

from typing import Any

from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crc.analysis.rollouts import make_environment
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.experiments.provenance import provenance
from sb3_crc.experiments.runs import FINAL, Run, write_json
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK

#: Seed of the final evaluation of every run: no training has it, and no evaluation during training (sb3_crc.evaluation)
FIRST_SEED = 10_000
EPISODES = 10


def load_final(run: Run) -> SAC:
    """
    :param run: one that has ended
    :return: its final policy, on the CPU
    :raises FileNotFoundError: if training has not ended
    :raises ValueError: if its algorithm is none of ours
    """
    check_name(f"algorithm of {run.folder}:", run.preset, [*PRESETS, *STOCK])
    if not run.model.exists():
        raise FileNotFoundError(f"{run.folder} has no final policy: its training has not ended ({run.model.name} is missing)")
    algorithm = CRCSAC if run.preset in PRESETS else SAC
    return algorithm.load(run.model, device="cpu")


def final_returns(run: Run, *, episodes: int = EPISODES, seed: int = FIRST_SEED) -> list[float]:
    """
    Evaluate the final policy by its mean action, in the environment that it was trained in.

    :param run: one that has ended
    :param episodes: how many
    :param seed: of the environment, from which all its episodes follow
    :return: their undiscounted returns
    """
    return _returns(load_final(run), run, episodes, seed)


def evaluate_final(run: Run, *, episodes: int = EPISODES, seed: int = FIRST_SEED) -> dict[str, Any]:
    """
    Write ``final.json`` into the run's folder: what the policy after exactly the budget is worth. Never the best checkpoint.

    :param run: one that has ended
    :param episodes: how many
    :param seed: of the environment, from which all its episodes follow
    :return: what was written: ``returns``, and when, on what and how they were measured
    :raises FileNotFoundError: if training has not ended
    :raises ValueError: if the policy has seen more or less than the budget
    """
    model = load_final(run)
    steps = model.num_timesteps * run.action_repeat
    if steps != run.budget:
        raise ValueError(
            f"{run.folder}: its policy has seen {steps} environment steps, its budget is {run.budget}; "
            "only a policy after exactly the budget is scored"
        )
    final = {
        "policy": "final",
        "environment_steps": steps,
        "agent_steps": model.num_timesteps,
        "updates": model._n_updates,
        "seconds": _training_seconds(run),
        "first_seed": seed,
        "returns": _returns(model, run, episodes, seed),
        "evaluated": provenance(),
    }
    write_json(final, run.folder / FINAL)
    return final


def _returns(model: SAC, run: Run, episodes: int, seed: int) -> list[float]:
    env = DummyVecEnv([lambda: Monitor(make_environment(run, seed))])
    if not run.is_of_suite:
        env.seed(seed)
    try:
        returns, _ = evaluate_policy(model, env, n_eval_episodes=episodes, return_episode_rewards=True)
    finally:
        env.close()
    assert isinstance(returns, list)
    return [float(value) for value in returns]


def _training_seconds(run: Run) -> float | None:
    seconds = (run.evaluations or {}).get("training_seconds")
    return None if seconds is None else float(seconds)

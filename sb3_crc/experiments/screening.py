"""What the settings of a configuration get from states: minutes, before hours are spent on pixels."""

from collections.abc import Mapping
from typing import Any

from gymnasium.wrappers import TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.experiments.ladder import learning_curve, normalized
from sb3_crc.schedules import lr_schedule

#: Settings that stock SAC has too
SHARED = (
    *("batch_size", "buffer_size", "learning_starts", "train_freq", "gradient_steps", "n_steps"),
    *("gamma", "tau", "target_update_interval", "ent_coef", "target_entropy"),
)
#: All that is used of a configuration
USED = (
    *SHARED,
    *("n_timesteps", "learning_rate", "ent_coef_learning_rate", "reward_scale"),
    *("policy_kwargs.net_arch", "policy_kwargs.layer_norm"),
)


class _OwnEntropyRate(SAC):
    """SAC whose entropy coefficient has a constant learning rate of its own."""

    entropy_rate: float | None = None

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        if self.entropy_rate is not None and self.ent_coef_optimizer is not None:
            for group in self.ent_coef_optimizer.param_groups:
                group["lr"] = self.entropy_rate


def screened_state_sac(
    task: str, settings: Mapping[str, Any], *, evaluations: int = 10, episodes: int = 3, seed: int = 0
) -> dict[str, Any]:
    """
    Train stock SAC on the task's states, at the repeat that its pixels have, with what a configuration says of rates, returns,
    rewards, replay ratio and heads. What has no counterpart there is left out: augmentations, objectives, the encoder,
    ``policy_delay``, ``initial_updates``.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param settings: of rl_zoo3; ``n_timesteps`` agent steps
    :param evaluations: how often it is evaluated, at equal distances
    :param episodes: fresh ones of each evaluation, with the policy's mean
    :param seed: of everything; evaluations use seed + 1000
    :return: the settings that were used, and the curve as environment steps, means and standard deviations
    :raises ValueError: if there is no budget in the settings, or the layers that are to be normalised have several widths
    """
    if "n_timesteps" not in settings:
        raise ValueError("settings without n_timesteps: nothing says how long to train")
    used = {name: settings[name] for name in SHARED if name in settings}
    policy_kwargs, heads = dict(settings.get("policy_kwargs") or {}), {}
    if "net_arch" in policy_kwargs:
        heads["net_arch"] = policy_kwargs["net_arch"]
        if policy_kwargs.get("layer_norm"):
            heads["activation_fn"] = normalized(policy_kwargs["net_arch"])
    reward_scale, rate = settings.get("reward_scale", 1.0), settings.get("learning_rate", 3e-4)
    env, fresh = (make_dmc(task, observation="state", seed=seed + offset) for offset in (0, 1000))
    scaled = TransformReward(env, lambda reward: reward_scale * float(reward))
    model = _OwnEntropyRate(
        "MlpPolicy", scaled, seed=seed, device="cpu", learning_rate=lr_schedule(rate), policy_kwargs=heads, **used
    )
    model.entropy_rate = settings.get("ent_coef_learning_rate")
    curve = learning_curve(model, Monitor(fresh), settings["n_timesteps"], evaluations, episodes, env.action_repeat)
    used |= {"n_timesteps": settings["n_timesteps"], "learning_rate": rate, "reward_scale": reward_scale}
    used |= {
        "ent_coef_learning_rate": model.entropy_rate,
        "policy_kwargs": {k: policy_kwargs.get(k) for k in ("net_arch", "layer_norm")},
    }
    return {"task": task, "seed": seed, "settings": used, "episodes": episodes, "curve": curve}

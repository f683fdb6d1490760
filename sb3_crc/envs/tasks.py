"""Static tables of the dm_control suite: task names, action repeats, cameras, environment ids.

Importing this module loads neither dm_control nor Shimmy nor MuJoCo, so that the ids can be registered for every user of the
package, and a rendering back end can still be chosen afterwards.
"""

from __future__ import annotations

import difflib

import gymnasium as gym

NAMESPACE = "dmc_pixels"

SUITE_TASKS: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "lqr": ("lqr_2_1", "lqr_6_2"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}
"""Every (domain, tasks) of ``dm_control.suite`` 1.0.50; a test compares it with ``suite.ALL_TASKS``."""

PAPER_TASKS: tuple[str, ...] = (
    "cartpole-swingup",
    "reacher-easy",
    "cheetah-run",
    "ball_in_cup-catch",
    "finger-spin",
    "walker-walk",
    "quadruped-walk",
    "hopper-hop",
    "walker-run",
    "finger-turn_hard",
)
"""The ten tasks of CRC-RL (arXiv 2301.13473): six of the PlaNet benchmark and four harder ones."""

ACTION_REPEATS: dict[str, int] = {
    # PlaNet (arXiv 1811.04551), appendix "Control Tasks"; SAC+AE, CURL, RAD, DrQ and CRC-RL took these values over.
    "cartpole": 8,
    "reacher": 4,
    "cheetah": 4,
    "ball_in_cup": 4,
    "finger": 2,
    "walker": 2,
}
DEFAULT_ACTION_REPEAT = 2
"""For the domains that PlaNet has no value for. DrQ-v2 (arXiv 2107.09645) and DreamerV3 (arXiv 2301.04104) use 2 for every
task of the suite, so their published scores on the harder tasks (quadruped, hopper, humanoid, ...) are comparable; the legged
tasks among them also fall over within a few of the longer steps."""

CAMERAS: dict[str, int] = {
    # Chosen by looking at pictures of every domain. Camera 0 ("global") of quadruped stands still: the body covers 3 % of the
    # picture's width and walks out of it. Camera 1 ("x") cuts off the feet, camera 3 looks out of the eyes.
    # Camera 2 ("y") follows the whole body: the choice of drqv2 and dmc2gym too.
    "quadruped": 2,
    "lqr": 1,  # camera 0 loses the chain to the side; camera 1 shows the whole rail
    "dog-fetch": 2,  # camera 0 follows the ball and never shows the dog; 2 is camera 0 ("y-axis") of the other dog tasks
}
"""The camera by domain or by "domain-task"; all others look through the suite's camera 0."""


def task_names() -> list[str]:
    """Every task as "domain-task", in the order of the suite."""
    return [f"{domain}-{task}" for domain, tasks in SUITE_TASKS.items() for task in tasks]


def environment_id(task: str) -> str:
    """The Gymnasium id of a task: "cartpole-swingup" -> "dmc_pixels/cartpole-swingup-v0"."""
    return f"{NAMESPACE}/{task}-v0"


def task_of(env_id: str) -> str:
    """:param env_id: of Gymnasium; :return: "domain-task" for ids of :func:`environment_id`, the id itself for any other"""
    return env_id.removeprefix(f"{NAMESPACE}/").removesuffix("-v0") if env_id.startswith(f"{NAMESPACE}/") else env_id


def split_task(task: str) -> tuple[str, str]:
    """Split a task's name into the suite's domain and task.

    :param task: "domain-task" with the suite's own spelling, for instance "ball_in_cup-catch"; a whole
        id "dmc_pixels/ball_in_cup-catch-v0" is accepted too
    :return: for instance ("ball_in_cup", "catch")
    :raises ValueError: if the suite has no such domain or task; the message names the nearest one
    """
    name = task.removeprefix(f"{NAMESPACE}/").removesuffix("-v0")
    domain, _, subtask = name.partition("-")
    if subtask in SUITE_TASKS.get(domain, ()):
        return domain, subtask
    if domain in SUITE_TASKS:
        problem = f"domain {domain!r} has no task {subtask!r}, only {', '.join(SUITE_TASKS[domain])}"
        candidates = [f"{domain}-{known}" for known in SUITE_TASKS[domain]]
    else:
        problem = f"there is no domain {domain!r}; the domains are {', '.join(SUITE_TASKS)}"
        candidates = task_names()
    nearest = difflib.get_close_matches(name, candidates, n=1, cutoff=0.0)[0]
    raise ValueError(f"Unknown task {task!r}: {problem}. Did you mean {nearest!r}?")


def default_action_repeat(task: str) -> int:
    """Simulator steps per decision that the literature uses for this "domain-task"."""
    return ACTION_REPEATS.get(split_task(task)[0], DEFAULT_ACTION_REPEAT)


def default_camera(task: str) -> int:
    """The camera that shows what the agent of this "domain-task" needs to see."""
    domain, subtask = split_task(task)
    return CAMERAS.get(f"{domain}-{subtask}", CAMERAS.get(domain, 0))


def register_environments() -> None:
    """Register ``dmc_pixels/<domain>-<task>-v0`` for every suite task with Gymnasium; a second call changes nothing."""
    for task in task_names():
        if environment_id(task) not in gym.registry:
            gym.register(
                id=environment_id(task),
                entry_point="sb3_crc.envs.dmc:make_dmc",
                kwargs={"task": task},
                # The suite's own time limit truncates; the checker would draw and step once more for every environment.
                disable_env_checker=True,
                # Our wrappers themselves refuse a step before the first reset, but not one after set_state().
                order_enforce=False,
            )

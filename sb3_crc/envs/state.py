"""The whole state of a dm_control suite task as arrays and JSON scalars: read, checked, written back exactly.

``Physics.get_state`` of dm_control keeps positions and velocities only. But the solver starts from its last solution, episodes
draw their targets into the model, and the next reset depends on the task's random numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

State = dict[str, Any]

MODEL_FIELDS = (
    "body_pos",
    "body_quat",
    "dof_damping",
    "geom_pos",
    "geom_rgba",
    "geom_size",
    "hfield_data",
    "jnt_stiffness",
    "light_pos",
    "site_pos",
    "site_rgba",
    "site_size",
    "wrap_prm",
)
"""All fields of MuJoCo's model in which two environments of one suite task can differ: an episode's targets, gains and
terrain, and LQR's springs, which are drawn when it is made. A test compares every field of every task with this list, and
shows that no task keeps anything else from one step to the next."""


def read_task(environment: Any) -> State:
    """Copy everything on which the future of a dm_control environment depends.

    :param environment: ``dm_control.rl.control.Environment`` of a suite task
    :return: nested dictionaries of arrays, ints, floats, bools and strings
    """
    import mujoco

    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    integration = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, integration, mujoco.mjtState.mjSTATE_INTEGRATION)
    return {
        "integration": integration,
        "sensors": data.sensordata.copy(),
        "model": {name: getattr(model, name).copy() for name in MODEL_FIELDS},
        "random": environment.task.random.get_state(legacy=False),
        "step_count": int(environment._step_count),
        "reset_next_step": bool(environment._reset_next_step),
    }


def write_task(environment: Any, state: State) -> None:
    """Bring a dm_control environment into the state that :func:`read_task` returned; the next picture is right too.

    :param environment: of the same task, reset at least once
    :param state: checked with :func:`check_state`
    """
    import mujoco

    physics = environment.physics
    model, data = physics.model.ptr, physics.data.ptr
    for name, values in state["model"].items():
        getattr(model, name)[...] = values
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state["integration"], mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)  # dm_control's step begins with MuJoCo's second half: the contacts must be there
    data.sensordata[...] = state["sensors"]  # forces and accelerations were those of the past step
    if model.nhfield:  # OpenGL has its own copy of a terrain
        with physics.contexts.gl.make_current() as context:
            for terrain in range(model.nhfield):
                context.call(mujoco.mjr_uploadHField, model, physics.contexts.mujoco.ptr, terrain)
    environment.task.random.set_state(state["random"])
    environment._step_count = state["step_count"]
    environment._reset_next_step = state["reset_next_step"]


def check_state(state: Any, own: State) -> None:
    """Refuse a state that does not fit, before anything is changed.

    :param state: what is to be set
    :param own: the present state of the environment: its settings must be equal, everything else of the same form
    :raises ValueError: for a state of other settings, naming both, and for anything missing, unknown or of another form
    """
    if not isinstance(state, dict) or not isinstance(state.get("settings"), dict):
        raise ValueError("This is not a state of get_state(): it has no settings.")
    theirs, ours = state["settings"], own["settings"]
    # A missing setting differs from every value, also from None.
    differing = [name for name in {**ours, **theirs} if name not in theirs or name not in ours or theirs[name] != ours[name]]
    if differing:
        raise ValueError(
            f"The state is of an environment with {_listed(theirs, differing)}, but this one has {_listed(ours, differing)}."
        )
    _check_form(state, own, "state")


def _listed(settings: State, names: list[str]) -> str:
    return ", ".join(f"{name}={settings[name]!r}" if name in settings else f"no {name}" for name in names)


def _check_form(value: Any, own: Any, place: str) -> None:
    if isinstance(own, dict):
        if not isinstance(value, dict):
            raise ValueError(f"{place} is {_form(value)}, not a dictionary.")
        for problem, names in (("lacks", own.keys() - value.keys()), ("has the unknown entries", value.keys() - own.keys())):
            if names:
                raise ValueError(f"{place} {problem} {', '.join(sorted(map(repr, names)))}.")
        for name, part in own.items():
            _check_form(value[name], part, f"{place}[{name!r}]")
    elif _form(value) != _form(own):
        raise ValueError(f"{place} is {_form(value)}; it must be {_form(own)}.")
    elif isinstance(own, str) and value != own:  # the names of the random number generators
        raise ValueError(f"{place} is {value!r}; it must be {own!r}.")


def _form(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array {value.dtype}{value.shape}"
    # None stands for a seed that is not pending
    return "an integer or None" if value is None or type(value) is int else f"of type {type(value).__name__}"

"""The Distracting Control Suite: the paper's ranges and speeds, by the pictures' scene and not by the code's own numbers."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dm_control import suite

from sb3_crc.envs.distractions.control_suite import SKY_SIDE, ControlSuite
from sb3_crc.envs.distractions.textures import Scene

SCALES = {"dcs_easy": 0.1, "dcs_medium": 0.2, "dcs_hard": 0.3}


@pytest.fixture
def clips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Six clips of 5 frames, each frame of one grey level: 10 x clip + frame."""
    monkeypatch.setenv("SB3_CRC_CACHE", str(tmp_path / "cache"))
    for clip in range(6):
        levels = (10 * clip + np.arange(5, dtype=np.uint8))[:, None, None, None]
        np.save(tmp_path / f"clip{clip}.npy", np.broadcast_to(levels, (5, 8, 8, 3)))
    return tmp_path


def made(mode: str, task: str = "walker-walk", data: Path | None = None, **kwargs: Any) -> tuple[ControlSuite, Scene]:
    domain, subtask = task.split("-")
    environment = suite.load(domain, subtask, task_kwargs={"random": 0})
    environment.reset()
    scene = Scene(environment.physics, task)
    scene.upload = lambda name: None  # type: ignore[method-assign]  # nothing is drawn here
    distraction = ControlSuite(mode, data, domain=domain, camera_id=0, **{"action_repeat": 1, **kwargs})
    distraction.restart(0)
    return distraction, scene


def camera(distraction: ControlSuite, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and axes (3, 3), in columns right, up and backward, with which a picture is taken."""
    data = scene.physics.data
    taken: list[np.ndarray] = []

    def render() -> np.ndarray:
        taken.extend([data.cam_xpos[0].copy(), data.cam_xmat[0].reshape(3, 3).copy()])
        return np.zeros(0)

    distraction.draw(render)
    return taken[0], taken[1]


@pytest.mark.parametrize("task", ["walker-walk", "cheetah-run"])  # from above, and level with the body
def test_the_camera_turns_within_the_papers_range(task: str) -> None:
    for mode, scale in SCALES.items():
        distraction, scene = made(mode, task)
        data = scene.physics.data
        own, axes = data.cam_xpos[0].copy(), data.cam_xmat[0].reshape(3, 3).copy()
        centre = data.subtree_com[0]
        target = own - axes[:, 2] * float((centre - own) @ -axes[:, 2])
        offset = own - target
        turns, rises, factors, rolls = [], [], [], []
        for _ in range(150):
            distraction.begin(scene)
            position, moved = camera(distraction, scene)
            now = position - target
            assert np.allclose(moved.T @ moved, np.eye(3)) and np.linalg.det(moved) == pytest.approx(1)
            assert moved[:, 2] == pytest.approx(now / np.linalg.norm(now))  # it still looks at the target
            turn = math.atan2(now[1], now[0]) - math.atan2(offset[1], offset[0])
            turns.append((turn + math.pi) % (2 * math.pi) - math.pi)
            rises.append(math.asin(now[2] / np.linalg.norm(now)) - math.asin(offset[2] / np.linalg.norm(offset)))
            factors.append(np.linalg.norm(now) / np.linalg.norm(offset))
            level = np.cross([0, 0, 1], moved[:, 2])
            rolls.append(math.acos(np.clip(moved[:, 0] @ level / np.linalg.norm(level), -1, 1)))
            assert position[2] >= target[2] - 1e-9
        most = scale * math.pi / 2
        assert 0.9 * most < np.max(np.abs(turns)) <= most + 1e-9
        assert np.min(turns) < 0 < np.max(turns)
        assert 0.9 * most < np.max(rises) <= most + 1e-9
        assert 0.9 * most < np.max(rolls) <= most + 1e-6
        assert 1 - 0.5 * scale - 1e-9 <= np.min(factors) < 1 - 0.4 * scale
        assert 1 + 1.5 * scale + 1e-9 >= np.max(factors) > 1 + 1.3 * scale


def test_from_above_the_camera_turns_to_all_sides() -> None:
    distraction, scene = made("dcs_hard", "reacher-easy")
    own = scene.physics.data.cam_xpos[0].copy()
    sides = []
    for _ in range(60):
        distraction.begin(scene)
        sides.append(camera(distraction, scene)[0] - own)
    assert np.min(sides, axis=0)[:2].max() < -0.1 and np.max(sides, axis=0)[:2].min() > 0.1


def test_the_camera_moves_slowly_and_its_own_place_is_kept() -> None:
    scale = 0.3
    distraction, scene = made("dcs_hard")
    data = scene.physics.data
    own = data.cam_xpos.copy(), data.cam_xmat.copy()
    distraction.begin(scene)
    steps, velocities = [], []
    for _ in range(300):
        position, axes = camera(distraction, scene)
        distraction.advance()
        moved, turned = camera(distraction, scene)
        steps.append(np.linalg.norm(moved - position))
        velocities.append(np.abs(distraction.get_state()["velocity"]))
        assert not np.array_equal(axes, turned)
    assert 0.1 * scale < np.median(steps)
    axes = own[1][0].reshape(3, 3)
    radius = float((own[0][0] - data.subtree_com[0]) @ axes[:, 2])
    fastest = [*[0.4 * scale / radius] * 3, scale * math.pi / 50]
    assert np.max(velocities, axis=0) == pytest.approx(fastest)
    assert np.array_equal(own[0], data.cam_xpos) and np.array_equal(own[1], data.cam_xmat)


def test_the_cameras_own_place_is_put_back_when_drawing_fails() -> None:
    distraction, scene = made("dcs_hard")
    distraction.begin(scene)
    own = scene.physics.data.cam_xpos.copy()
    with pytest.raises(ZeroDivisionError):
        distraction.draw(lambda: np.array(1 // 0))
    assert np.array_equal(own, scene.physics.data.cam_xpos)


def test_all_materials_vary_within_the_papers_range() -> None:
    scale = 0.2
    distraction, scene = made("dcs_medium")
    colours = scene.physics.model.mat_rgba
    own = colours.copy()
    assert len(own) > 5
    lowest, highest = (own[:, :3] - scale).clip(0, 1) - 1e-6, (own[:, :3] + scale).clip(0, 1) + 1e-6
    drawn = []
    for _ in range(40):
        distraction.begin(scene)
        drawn.append(colours[:, :3].copy())
    for _ in range(400):
        before = colours[:, :3].copy()
        distraction.advance()
        change = np.abs(colours[:, :3] - before)
        assert 0 < change.max() < 6 * 0.03 * scale
        drawn.append(colours[:, :3].copy())
    assert (np.array(drawn) >= lowest).all() and (np.array(drawn) <= highest).all()
    assert (np.ptp(np.array(drawn), axis=0) > 0.8 * (highest - lowest)).all()


@pytest.mark.parametrize(("task", "alpha"), [("reacher-easy", 0.0), ("walker-walk", 1.0), ("cartpole-swingup", 0.3)])
def test_the_floor_lets_the_sky_through(task: str, alpha: float) -> None:
    distraction, scene = made("dcs_easy", task)
    alphas = scene.physics.model.mat_rgba[:, 3]
    own = alphas.copy()
    distraction.begin(scene)
    own[scene.material("grid")] = alpha
    assert alphas == pytest.approx(own)


def test_the_first_clips_are_shown_to_and_fro(clips: Path) -> None:
    distraction, scene = made("dcs_easy", data=clips, action_repeat=1)
    seen, firsts, directions = set(), set(), set()
    for _ in range(60):
        distraction.begin(scene)
        sky = scene.texture("skybox")
        assert sky.shape == (SKY_SIDE, SKY_SIDE, 3) and len(np.unique(sky)) == 1
        frames = [int(sky[0, 0, 0])]
        for _ in range(9):
            distraction.advance()
            frames.append(int(scene.texture("skybox")[0, 0, 0]))
        clip = frames[0] // 10
        assert {frame // 10 for frame in frames} == {clip} and {frame % 10 for frame in frames} == {0, 1, 2, 3, 4}
        assert set(np.abs(np.diff(frames))) == {1}
        seen.add(clip)
        firsts.add(frames[0] % 10)
        directions.add(frames[1] - frames[0])
    assert (seen, firsts, directions) == ({0, 1, 2, 3}, {0, 1, 2, 3, 4}, {-1, 1})


def test_it_moves_with_every_control_step() -> None:
    one, scene = made("dcs_hard", action_repeat=1)
    four, other_scene = made("dcs_hard", action_repeat=4)
    for distraction, own in ((one, scene), (four, other_scene)):
        distraction.begin(own)
    for _ in range(4):
        one.advance()
    four.advance()
    ours, theirs = one.get_state(), four.get_state()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ("colours", "pose", "velocity", "frame"))
    assert np.array_equal(scene.texture("skybox"), other_scene.texture("skybox"))


@pytest.mark.parametrize(("dynamic", "moves"), [(True, True), (False, False)])
def test_what_is_static_changes_at_a_reset_only(dynamic: bool, moves: bool) -> None:
    distraction, scene = made("dcs_hard", dynamic=dynamic)

    def drawn() -> list[np.ndarray]:
        colours, sky = scene.physics.model.mat_rgba.copy(), scene.texture("skybox").copy()
        return [*camera(distraction, scene), colours, sky]

    distraction.begin(scene)
    first = drawn()
    for _ in range(3):
        distraction.advance()
    assert [not np.array_equal(*pair) for pair in zip(first, drawn(), strict=True)] == [moves] * 4
    distraction.begin(scene)
    assert not any(np.array_equal(*pair) for pair in zip(first, drawn(), strict=True))

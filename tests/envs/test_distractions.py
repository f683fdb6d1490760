"""Distracted environments: the benchmark's facts, determinism, states, and what users get wrong."""

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch as th
from dm_control import suite
from dm_control.mujoco import Physics
from dm_control.suite import common
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from torch.nn import functional as F

from sb3_crc import make_dmc
from sb3_crc.envs.distractions import DISTRACTIONS
from sb3_crc.envs.distractions.chroma import GREEN, green_mask
from sb3_crc.envs.distractions.clips import PROCEDURAL_FRAMES, ProceduralClip, bilinear, find_clips, what_they_are
from sb3_crc.envs.distractions.colours import DEFAULT, generated_table
from sb3_crc.envs.distractions.textures import Scene
from sb3_crc.envs.tasks import PAPER_TASKS

SMALL: dict[str, Any] = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Resized clips of tests stay among the tests."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("SB3_CRC_CACHE", str(folder))
    return folder


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Three clips of 4 frames: each frame of one grey level, 10 x clip + frame."""
    folder = tmp_path / "clips"
    folder.mkdir()
    for clip in range(3):
        levels = (10 * clip + np.arange(4, dtype=np.uint8))[:, None, None, None]
        np.savez(folder / f"video{clip}.npz", np.broadcast_to(levels, (4, 20, 30, 3)))
    return folder


def rolled(env: Any, steps: int = 30, seed: int = 0) -> tuple[list[np.ndarray], list[float]]:
    """Frames and rewards over a bit more than an episode."""
    rng = np.random.default_rng(seed)
    frames, rewards = [], []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        frames.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            frames.append(env.reset()[0])
    return frames, rewards


# -- The benchmark's facts ---------------------------------------------------------------------------------------------


def recompiled_picture(task: str, seed: int, colours: dict[str, np.ndarray]) -> np.ndarray:
    """The benchmark's own way: other colours in the XML, compiled anew, then the state put back."""
    domain, subtask = task.split("-")
    environment = suite.load(domain, subtask, task_kwargs={"random": seed})
    environment.reset()
    texts = {name: " ".join(map(str, values)) for name, values in colours.items()}
    assets = dict(common.ASSETS)
    for file, changes in {
        "./common/materials.xml": {"texture[@name='grid']": ("rgb1", "rgb2"), "material[@name='self']": ("rgba",)},
        "./common/skybox.xml": {"texture[@name='skybox']": ("rgb1",)},
    }.items():
        root = ElementTree.fromstring(assets[file])
        for path, attributes in changes.items():
            (element,) = root.findall(f".//{path}")
            for attribute in attributes:
                name = {"rgba": "self_rgb"}.get(attribute, f"{element.get('name')}_{attribute}")
                value = texts["skybox_rgb" if name == "skybox_rgb1" else name]
                element.set(attribute, f"{value} 1" if attribute == "rgba" else value)
        assets[file] = ElementTree.tostring(root)
    physics = environment.physics
    state = physics.get_state()
    physics.reload_from_xml_string(common.read_model(f"{domain}.xml"), assets)
    physics.set_state(state)
    physics.forward()
    return np.array(physics.render(64, 64, camera_id=0))


@pytest.mark.parametrize("task", ["cartpole-swingup", "walker-walk"])
def test_colours_in_place_equal_those_of_another_compilation(task: str) -> None:
    env = make_dmc(task, seed=5, image_size=64, distraction="color_hard")
    observation, _ = env.reset()
    entry = np.random.RandomState(5).randint(100)  # the benchmark's rule
    colours = {name: values[entry] for name, values in generated_table("color_hard").items()}
    ours, theirs = observation[-3:].transpose(1, 2, 0).astype(int), recompiled_picture(task, 5, colours).astype(int)
    plain, _ = make_dmc(task, seed=5, image_size=64).reset()
    assert np.abs(ours - theirs).max() <= 1
    assert np.abs(plain[-3:].transpose(1, 2, 0).astype(int) - theirs).max() > 30  # there was something to be changed


#: Share of the picture that the key takes at 100 pixels, video_easy and video_hard
SHARES = {
    "cartpole-swingup": (0.65, 0.98),
    "cheetah-run": (0.82, 0.96),
    "walker-walk": (0.58, 0.93),
    "ball_in_cup-catch": (0.74, 0.99),
    "finger-spin": (0.68, 0.93),
    "reacher-easy": (0.0, 0.93),
}


@pytest.mark.filterwarnings("ignore:video_easy changes nothing of reacher")
@pytest.mark.parametrize("task", SHARES)
def test_the_key_takes_as_much_as_the_benchmarks(task: str) -> None:
    for mode, share in zip(("video_easy", "video_hard"), SHARES[task], strict=True):
        env = make_dmc(task, seed=3, image_size=100, distraction=mode)
        env.reset()
        mask = green_mask(np.array(env.get_wrapper_attr("take_picture")()))
        assert mask.mean() == pytest.approx(share, abs=0.04)
        env.close()


def rail_and_picture(**kwargs: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of cartpole, at 100 pixels: where the rails are, the picture before and after it was distracted."""
    env = make_dmc("cartpole-swingup", seed=3, image_size=100, **kwargs)
    observation, _ = env.reset()
    take = env.get_wrapper_attr("take_picture")
    model = env.get_wrapper_attr("physics").model
    rails = [model.name2id(name, "geom") for name in ("rail1", "rail2")]
    return np.isin(take(segmentation=True)[..., 0], rails), np.array(take()), observation[-3:].transpose(1, 2, 0)


def test_the_key_eats_cartpoles_rail() -> None:
    rail, picture, _ = rail_and_picture(distraction="video_hard")
    assert rail.sum() > 100
    assert green_mask(picture)[rail].all()


def test_the_segmentation_keeps_it() -> None:
    rail, picture, distracted = rail_and_picture(distraction="video_hard", distraction_mask="segmentation")
    assert np.array_equal(distracted[rail], picture[rail])
    assert (distracted != picture).any(axis=2).mean() > 0.9


def test_whole_numbers_key_what_the_benchmarks_floats_key() -> None:
    colours = np.random.default_rng(0).integers(0, 256, (300, 300, 3), dtype=np.uint8)
    red, green, blue = (colours[..., channel].astype(np.float64) for channel in range(3))
    value = colours.max(axis=2).astype(np.float64)
    spread = value - colours.min(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        sectors = [(green - blue) / spread % 6, (blue - red) / spread + 2, (red - green) / spread + 4]
        hue = 60 * np.select([value == red, value == green], sectors[:2], sectors[2])
        saturation = 255 * spread / value
    expected = (hue >= 100) & (hue <= 185) & (saturation >= 80) & (value >= 70)
    tie = np.isclose(hue, 100) | np.isclose(hue, 185) | np.isclose(saturation, 80)
    assert np.array_equal(green_mask(colours)[~tie], expected[~tie])
    assert 0.05 < expected.mean() < 0.5
    assert green_mask(np.full((1, 1, 3), GREEN, np.uint8)).all()


@pytest.mark.parametrize(("mode", "spread"), [("color_easy", 0.1), ("color_hard", 0.2)])
def test_generated_colours_are_distributed_like_the_benchmarks(mode: str, spread: float) -> None:
    table = generated_table(mode)
    assert all(values.shape == (100, 3) and values.min() >= 0 and values.max() <= 1 for values in table.values())
    unclipped = (table["self_rgb"] > 0) & (table["self_rgb"] < 1)
    deviations = (table["self_rgb"] - DEFAULT["self_rgb"])[unclipped]
    assert abs(deviations.mean()) < 0.25 * spread
    assert 0.75 * spread < deviations.std() < 1.15 * spread
    assert np.allclose(table["grid_rgb2"], table["grid_rgb1"] + 0.1)


def test_clips_are_resized_as_torch_does() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (37, 61, 3), dtype=np.uint8)
    pixels = th.from_numpy(picture).permute(2, 0, 1)[None] / 255
    for side in (20, 36, 100):
        resized = F.interpolate(pixels, (side, side), mode="bilinear", align_corners=False)[0] * 255
        difference = bilinear(picture, side).astype(int) - resized.permute(1, 2, 0).numpy().astype(np.uint8)
        assert np.abs(difference).max() <= 1  # where a float lies at a whole number
        assert (difference != 0).mean() < 0.01


# -- Videos ------------------------------------------------------------------------------------------------------------


def shown(observation: np.ndarray) -> int:
    """The grey level at the top of the newest frame, where the sky is."""
    assert len(np.unique(observation[-3:, 0, 0])) == 1
    return int(observation[-1, 0, 0])


def test_episodes_show_clips_in_turn_and_decisions_their_frames(clips: Path) -> None:
    env = make_dmc("cartpole-swingup", seed=0, distraction="video_easy", distraction_data=clips, **SMALL)
    action = np.zeros(1, np.float32)
    for clip in (1, 2, 0, 1):
        assert shown(env.reset()[0]) == 10 * clip
        levels = [shown(env.step(action)[0]) - 10 * clip for _ in range(6)]
        assert levels == [1, 2, 3, 0, 1, 2]
    assert shown(env.reset(seed=0)[0]) == 10  # as good as new


def test_a_clip_is_decoded_once(clips: Path, cache: Path) -> None:
    make_dmc("cartpole-swingup", distraction="video_easy", distraction_data=clips, **SMALL)
    kept = sorted(cache.iterdir())
    times = [path.stat().st_mtime_ns for path in kept]
    assert len(kept) == 3
    make_dmc("cartpole-swingup", distraction="video_hard", distraction_data=clips, **SMALL).reset()
    assert [path.stat().st_mtime_ns for path in sorted(cache.iterdir())] == times
    np.savez(clips / "video1.npz", np.full((9, 20, 30, 3), 77, np.uint8))  # another clip of the same name
    env = make_dmc("cartpole-swingup", distraction="video_easy", distraction_data=clips, **SMALL)
    assert shown(env.reset()[0]) == 77


def test_mp4(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in (40, 90, 140, 190):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    env = make_dmc("cartpole-swingup", distraction="video_easy", distraction_data=tmp_path, **SMALL)
    observation, _ = env.reset()
    assert np.abs(observation[-3:, 0, 0].astype(int) - 40).max() <= 3
    assert "1 clips of one's own" in env.get_wrapper_attr("distraction_label")


def test_procedural_clips_move_and_close() -> None:
    first, second = ProceduralClip(1, 24), ProceduralClip(2, 24)
    assert np.array_equal(first.frame(7), ProceduralClip(1, 24).frame(7))
    assert not np.array_equal(first.frame(7), second.frame(7))
    assert not np.array_equal(first.frame(7), first.frame(8))
    end, start = first.frame(PROCEDURAL_FRAMES).astype(int), first.frame(0).astype(int)
    assert np.abs(end - start).max() <= 1


def test_labels_say_what_is_not_the_benchmarks(tmp_path: Path, clips: Path) -> None:
    assert "3 clips of one's own" in what_they_are(find_clips(clips))
    (tmp_path / "fake").mkdir()
    (tmp_path / "fake" / "video0.mp4").write_bytes(b"not the original")
    assert "of one's own" in what_they_are(find_clips(tmp_path / "fake"))
    np.savez(tmp_path / "own.npz", **generated_table("color_easy"))
    for data, label in ((None, "color_easy (generated)"), (tmp_path / "own.npz", "color_easy (table own.npz)")):
        env = make_dmc("cartpole-swingup", distraction="color_easy", distraction_data=data, **SMALL)
        assert env.get_wrapper_attr("distraction_label") == label


def test_natural_order(tmp_path: Path) -> None:
    for name in ("video10.npy", "video2.npy", "video1.npy", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.stem for path in find_clips(tmp_path)] == ["video1", "video2", "video10"]


# -- As an environment -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [*DISTRACTIONS[:4], "dcs_hard"])
def test_the_task_stays_the_same_and_pictures_follow_from_the_seed(mode: str) -> None:
    env, same, other = (make_dmc("cartpole-swingup", seed=seed, distraction=mode, **SMALL) for seed in (0, 0, 1))
    plain = make_dmc("cartpole-swingup", seed=0, **SMALL)
    for one in (env, same, other, plain):
        one.reset()
    frames, rewards = rolled(env)
    same_frames, same_rewards = rolled(same)
    plain_frames, plain_rewards = rolled(plain)
    assert rewards == same_rewards == plain_rewards
    assert all(np.array_equal(*pair) for pair in zip(frames, same_frames, strict=True))
    assert not any(np.array_equal(*pair) for pair in zip(frames, plain_frames, strict=True))
    if not mode.startswith("video"):  # nothing of the benchmark's videos is drawn by lot
        colours = [np.median(one.reset(seed=seed)[0], axis=(1, 2)) for one, seed in ((env, 0), (other, 1))]
        assert not np.array_equal(*colours)


@pytest.mark.parametrize("mode", [*DISTRACTIONS[1:4:2], "dcs_hard"])
def test_a_state_continues_exactly(mode: str) -> None:
    env = make_dmc("cartpole-swingup", seed=0, distraction=mode, **SMALL)
    env.reset()
    rolled(env, 33)
    state = env.get_state()
    other = make_dmc("cartpole-swingup", seed=9, distraction=mode, **SMALL)
    other.reset()
    rolled(other, 3)
    other.set_state(state)
    for one, two in zip(rolled(env, 60), rolled(other, 60), strict=True):
        assert all(np.array_equal(*pair) for pair in zip(one, two, strict=True))
    with pytest.raises(ValueError, match="distraction"):
        make_dmc("cartpole-swingup", seed=9, **SMALL).set_state(state)


def test_gymnasium_accepts_it() -> None:
    check_env(make_dmc("cartpole-swingup", distraction="dcs_hard", **SMALL), skip_render_check=True)


@pytest.mark.parametrize("mode", ["color_hard", "video_hard", "dcs_hard"])
def test_other_processes(mode: str) -> None:
    kwargs = {"env_id": make_dmc, "n_envs": 2, "seed": 3}
    env_kwargs = {"task": "cartpole-swingup", "distraction": mode, **SMALL}
    observations = []
    for vec_env_cls in (DummyVecEnv, SubprocVecEnv):
        env = make_vec_env(**kwargs, env_kwargs=env_kwargs, vec_env_cls=vec_env_cls)
        frames = [env.reset()]
        frames += [env.step(np.full((2, 1), 0.5, np.float32))[0] for _ in range(3)]
        observations.append(np.stack(frames))
        env.close()
    assert np.array_equal(*observations)


@pytest.mark.filterwarnings("ignore:video_easy changes nothing of reacher")
@pytest.mark.parametrize("task", PAPER_TASKS)
def test_all_tasks_of_the_paper_can_be_distracted(task: str) -> None:
    plain, _ = make_dmc(task, seed=2, **SMALL).reset()
    for mode in ("color_hard", "video_hard", "dcs_hard"):
        env = make_dmc(task, seed=2, distraction=mode, **SMALL)
        observation, _ = env.reset()
        assert (observation != plain).mean() > 0.3
        large = env.render()
        assert large.shape == (480, 480, 3)
        small = bilinear(np.ascontiguousarray(large), 36).astype(int) - observation[-3:].transpose(1, 2, 0)
        assert np.median(np.abs(small)) < 12  # the same scene, larger
        env.close()


@pytest.mark.parametrize(("mode", "moves"), [("dcs_hard", True), ("dcs_hard_static", False)])
def test_what_is_static_changes_at_a_reset_only(mode: str, moves: bool) -> None:
    env = make_dmc("cartpole-swingup", seed=0, distraction=mode, **SMALL)

    def drawn() -> list[np.ndarray]:
        state = env.get_state()["distraction"]
        return [np.array(state[name]) for name in ("colours", "pose", "frame")]

    env.reset()
    first = drawn()
    for _ in range(3):
        env.step(np.zeros(1, np.float32))
    assert all(np.array_equal(*pair) for pair in zip(first, drawn(), strict=True)) == (not moves)
    env.reset()
    assert not any(np.array_equal(*pair) for pair in zip(first, drawn(), strict=True))


def test_the_camera_of_the_simulator_is_put_back() -> None:
    env = make_dmc("walker-walk", seed=0, distraction="dcs_hard", **SMALL)
    env.reset()
    data = env.get_wrapper_attr("physics").data
    before = data.cam_xpos.copy(), data.cam_xmat.copy()
    env.render()
    assert np.array_equal(before[0], data.cam_xpos) and np.array_equal(before[1], data.cam_xmat)


def test_dict_observations(clips: Path) -> None:
    env = make_dmc("cartpole-swingup", observation="dict", distraction="video_easy", distraction_data=clips, **SMALL)
    assert shown(env.reset()[0]["pixels"]) == 10


# -- What users get wrong ----------------------------------------------------------------------------------------------


def test_reacher_warns() -> None:
    with pytest.warns(UserWarning, match="video_easy changes nothing of reacher"):
        make_dmc("reacher-easy", distraction="video_easy", **SMALL)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"distraction": "video_eazy"}, "video_eazy.*Did you mean 'video_easy'"),
        ({"distraction": "video_easy", "distraction_mask": "depth"}, "depth.*chroma.*segmentation"),
        ({"distraction": "color_easy", "observation": "state"}, "observation='state' has none"),
        ({"distraction_data": "somewhere"}, "none is given"),
        ({"distraction": "dcs_easy", "camera_id": -1}, "free camera"),
    ],
)
def test_arguments_that_cannot_be(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_dmc("cartpole-swingup", **{**SMALL, **kwargs})


def test_a_scene_without_sky_or_floor_is_named() -> None:
    bare = Physics.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(
        ValueError, match="own-task cannot be distracted: its scene has no texture 'skybox', no texture 'grid'"
    ):
        Scene(bare, "own-task")


def test_data_that_are_missing(tmp_path: Path) -> None:
    for mode in ("video_easy", "color_easy", "dcs_easy"):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            make_dmc("cartpole-swingup", distraction=mode, distraction_data=tmp_path / "nowhere", **SMALL)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no clip in .*empty"):
        make_dmc("cartpole-swingup", distraction="video_easy", distraction_data=tmp_path / "empty", **SMALL)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.mp4", b"no video", r"broken\.mp4 cannot be read as a video"),
        ("broken.npz", b"no archive", r"broken\.npz is no clip"),
        ("short.npy", np.zeros((1, 8, 8, 3), np.uint8), r"short\.npy is too short: 1 frames"),
        ("empty.npy", np.zeros((0, 8, 8, 3), np.uint8), r"empty\.npy is too short: 0 frames"),
        ("long.npy", np.zeros((10_001, 1, 1, 3), np.uint8), r"long\.npy is too long: more than 10000"),
        ("grey.npy", np.zeros((5, 8, 8), np.uint8), r"grey\.npy holds uint8 \(5, 8, 8\)"),
        ("floats.npy", np.zeros((5, 8, 8, 3)), r"floats\.npy holds float64"),
    ],
)
def test_clips_that_are_none(tmp_path: Path, name: str, content: Any, message: str) -> None:
    folder = tmp_path / "clips"
    folder.mkdir()
    if isinstance(content, bytes):
        (folder / name).write_bytes(content)
    else:
        np.save(folder / name, content)
    for mode in ("video_hard", "dcs_easy"):
        with pytest.raises(ValueError, match=message):
            make_dmc("cartpole-swingup", distraction=mode, distraction_data=folder, **SMALL)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no json", r"table\.json is no table of colours"),
        (json.dumps([{"self_rgb": [0, 0, 0]}]), r"table\.json is no table of colours.*grid_rgb1"),
        (json.dumps({name: [[0.5, 0.5]] for name in DEFAULT}), r"grid_rgb1 has shape \(1, 2\)"),
        (json.dumps({name: [[0.5, 0.5, 1.5]] for name in DEFAULT}), r"outside \[0, 1\]"),
        (json.dumps([]), r"shape"),
    ],
)
def test_tables_that_are_none(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "table.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        make_dmc("cartpole-swingup", distraction="color_hard", distraction_data=tmp_path / "table.json", **SMALL)


def test_tables_in_both_formats_are_one(tmp_path: Path) -> None:
    table = generated_table("color_hard")
    np.savez(tmp_path / "color_hard.npz", **table)
    entries = [{name: values[entry].tolist() for name, values in table.items()} for entry in range(100)]
    (tmp_path / "list.json").write_text(json.dumps(entries))
    pictures = [
        make_dmc("cartpole-swingup", seed=4, distraction="color_hard", distraction_data=data, **SMALL).reset()[0]
        for data in (None, tmp_path, tmp_path / "list.json")
    ]
    assert np.array_equal(pictures[0], pictures[1]) and np.array_equal(pictures[0], pictures[2])

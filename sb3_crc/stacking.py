"""How an environment stacks frames: what a FrameReplayBuffer must know of it."""

from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sb3_crc.image_spaces import image_shape, image_space


def stacked_frame_channels(env: VecEnv) -> int | None:
    """
    :param env: the training environment, images channel first
    :return: channels of one frame: of what SB3's VecFrameStack stacks, else the environment's attribute ``frame_channels``
        (:func:`~sb3_crc.make_dmc` has it); None if neither says that observations are stacks
    :raises ValueError: if parallel environments differ
    """
    stack = unwrap_vec_wrapper(env, VecFrameStack)
    if stack is not None:
        return image_shape(image_space(env.observation_space))[0] // stack.stacked_obs.n_stack
    if not env.has_attr("frame_channels"):
        return None
    channels: set[int | None] = set(env.get_attr("frame_channels"))
    if len(channels) > 1:
        raise ValueError(f"the environments disagree about frame_channels: {sorted(channels, key=str)}")
    return channels.pop()

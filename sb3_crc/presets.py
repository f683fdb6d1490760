"""The family on one page: each method is a set of arguments of :class:`~sb3_crc.CRCSAC`.

``CRCSAC("CnnPolicy", env, **PRESETS["rad"])``. What a preset does not name keeps the constructor's default.
"""

from typing import Any

#: CRC-RL's three losses at equal weights (arXiv 2301.13473). The consistency term is the mean over the latent: summed, it
#: swamps the other two at initialisation.
CRC_OBJECTIVES: dict[str, Any] = {
    "contrastive": 1 / 3,
    "reconstruction": 1 / 3,
    "consistency": {"weight": 1 / 3, "reduction": "mean"},
}

PRESETS: dict[str, dict[str, Any]] = {
    # CRC-RL: arXiv 2301.13473, its table of hyper-parameters; where that is silent, CURL's recipe (arXiv 2004.04136)
    "crc": {
        "learning_rate": 1e-3,
        "ent_coef_learning_rate": 1e-4,
        "ent_coef": "auto_0.1",
        "buffer_size": 100_000,
        "learning_starts": 1_000,
        "batch_size": 512,
        "tau": 0.01,
        "encoder_tau": 0.05,
        "gamma": 0.99,
        "policy_delay": 2,
        "target_update_interval": 2,
        "augmentation": "random_crop",
        "objectives": CRC_OBJECTIVES,
    },
    # CRC-RL as its released code does it: the rows of the README's table of differences, by settings. The latent penalty
    # and the decoder's weight decay enter the code's loss at weight 1, hence the division by the weight of the reconstruction.
    "crc_release": {
        "batch_size": 128,
        "augmentation": "random_crop_overlay",
        "augmentation_kwargs": {"last_offset": False},
        "reencode": True,
        "policy_kwargs": {"encoder_steps": 3},
        "objectives": {
            "contrastive": {"weight": 1 / 3, "initialization": "uniform", "symmetric": False},
            "reconstruction": {"weight": 1 / 3, "bits": 5, "latent_penalty": 3e-6, "decoder_penalty": 3e-7},
            "consistency": {
                "weight": 1 / 3,
                "predictor_side": "online",
                "predictor": "batch_norm",
                "normalize": True,
                "reduction": "mean",
            },
        },
    },
    # CURL: the contrastive loss alone (arXiv 2004.04136)
    "curl": {
        "augmentation": "random_crop",
        "objectives": {"contrastive": {"weight": 1.0, "initialization": "uniform", "symmetric": False}},
    },
    # RAD: random crops and nothing else (arXiv 2004.14990)
    "rad": {"augmentation": "random_crop", "objectives": {}},
    # SAC from pixels, the floor of every comparison: the same networks, neither augmentation nor objective
    "pixel_sac": {"augmentation": "center_crop", "objectives": {}},
}

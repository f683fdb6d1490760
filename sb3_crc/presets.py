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
    # CRC-RL as its released code does it: the rows of docs/fidelity.md, by settings. The latent penalty
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
    # SAC+AE: the reconstruction alone, of 5 bits, deterministic and regularised (arXiv 1910.01741, table 4, and its code).
    # Shared: encoder, decoder, heads, target networks, learning rates. Departures: one Adam steps encoder and decoder, the
    # decoder's weight decay is a penalty in the loss, and the middle of the frame is seen, where the code draws at the size of
    # its input (as zoo_configs/sac_ae.yml does).
    "sac_ae": {
        "batch_size": 128,
        "augmentation": "center_crop",
        "initial_updates": 999,
        "policy_kwargs": {"features_extractor_kwargs": {"latent_activation": "tanh"}},
        "objectives": {"reconstruction": {"weight": 1.0, "bits": 5, "latent_penalty": 1e-6, "decoder_penalty": 1e-7}},
    },
    # SODA: the consistency loss alone, from a strongly augmented view to the key encoder's latent of a weak one; critic and
    # actor see weak views only (arXiv 2011.13389 and the authors' dmcontrol-generalization-benchmark). Departures: the batch,
    # the encoder and its moving average are those of the critic (the code draws 256 other samples, and its own average with
    # rate 0.005 looks through a projection to 100 dimensions); its pictures of Places365 are smooth random ones unless
    # `objective_augmentation_kwargs={"source": folder}`.
    "soda": {
        "batch_size": 128,
        "augmentation": "random_crop",
        "objective_augmentation": "random_crop_overlay",
        "auxiliary_interval": 2,
        "objectives": {
            "consistency": {
                "weight": 1.0,
                "predictor_side": "online",
                "target": "positive",
                "predictor": "batch_norm",
                "normalize": True,
                "reduction": "mean",
            }
        },
    },
    # DrQ: random shifts, Q targets and Q losses each averaged over two of them, and no objective (arXiv 2004.13649, table 4).
    # Departures: its critic loss is the sum over the two augmentations, which Adam does not tell from the mean; each side has
    # augmentations of its own, where the code draws two of o_t and two of o_{t+1} with the sample.
    "drq": {
        "encoder_tau": 0.01,
        "ent_coef_learning_rate": 1e-3,
        "augmentation": "random_shift",
        "augmentation_kwargs": {"pad": 4},
        "q_augmentations": 2,
        "target_augmentations": 2,
        "objectives": {},
        "policy_kwargs": {"features_extractor_kwargs": {"latent_activation": "tanh"}},
    },
    # SAC from pixels, the floor of every comparison: the same networks, neither augmentation nor objective
    "pixel_sac": {"augmentation": "center_crop", "objectives": {}},
}

"""rl_zoo3 with our algorithms: the only package that imports it.

Each preset is an algorithm of the zoo (``--algo crc``, ``--algo rad``, ...), and so is the stock SAC to compare them with
(``sac``, ``sac_matched``, ``state_sac``). Runs read ``zoo_configs/<algo>.yml`` unless ``--conf-file`` names another file.
``python -m sb3_crc.zoo <command>`` runs the zoo's scripts with all their flags;
``python train.py`` is its ``train``.
"""

from sb3_crc.configurations import CONFIGS
from sb3_crc.zoo.algorithms import preset_class, register
from sb3_crc.zoo.commands import main, train
from sb3_crc.zoo.manager import CRCExperimentManager

__all__ = ["CONFIGS", "CRCExperimentManager", "main", "preset_class", "register", "train"]

"""Do runs agree with scores from before? What ``sb3-crc reproduced`` answers."""

from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.experiments.scores import final_means, one_protocol, read_scores


def compare_with(committed: Path, reproduced: Path) -> dict[str, Any]:
    """
    :param committed: CSV file of scores, or folder of runs
    :param reproduced: the same, of one method on one task
    :return: ``method``, ``task``, ``committed`` and ``reproduced`` returns by seed, and the 95 % ``interval`` in which the
        mean of the reproduced seeds is to be expected if nothing has changed (Student's t); None with one committed seed
    :raises ValueError: if one has no final score, or the other none of the same
    :raises MixedProtocols: if the two were measured in different ways, or runs of one of them were
    """
    import pandas as pd
    from scipy.stats import t

    new_rows, old_rows = read_scores([reproduced]).final, read_scores([committed]).final
    found = final_means(new_rows)
    if len(found[["method", "task"]].drop_duplicates()) != 1:
        raise ValueError(f"{reproduced} must hold final scores of one method on one task")
    method, task = found[["method", "task"]].iloc[0]
    old_rows = old_rows[(old_rows["method"] == method) & (old_rows["task"] == task)]
    if old_rows.empty:
        raise ValueError(f"{committed} has no final score of {method} on {task}")
    sides = [old_rows.assign(method="committed"), new_rows.assign(method="reproduced")]
    one_protocol(pd.concat(sides, ignore_index=True), remedy="")
    before = final_means(old_rows)
    old, new = before["return"].to_numpy(float), found["return"].to_numpy(float)
    interval = None
    if len(old) > 1:
        half = t.ppf(0.975, len(old) - 1) * old.std(ddof=1) * np.sqrt(1 / len(old) + 1 / len(new))
        interval = float(old.mean() - half), float(old.mean() + half)
    return {
        "method": str(method),
        "task": str(task),
        "committed": {int(seed): float(value) for seed, value in zip(before["seed"], old, strict=True)},
        "reproduced": {int(seed): float(value) for seed, value in zip(found["seed"], new, strict=True)},
        "interval": interval,
    }

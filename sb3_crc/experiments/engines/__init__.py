"""Engines: ways to work off the runs of a comparison. ``local``: processes of this machine. ``ray_cluster``: tasks of a Ray
cluster. ``slurm``: an array job of a Slurm cluster. All of them work through :mod:`~sb3_crc.experiments.engines.execution`."""

"""``python -m sb3_crc``: see cli.py."""

from sb3_crc.cli import app

app(prog_name="python -m sb3_crc")

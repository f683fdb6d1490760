"""dm_control tasks as Gymnasium environments; nothing here imports learning code, and learning code imports nothing here.

``tasks`` holds static tables and is cheap to import; ``dmc`` and ``rendering`` load the simulator only when they are called.
"""

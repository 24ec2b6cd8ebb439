"""Commands of the CLI, listed in ``table``. Each module has ``add_arguments`` and ``run``."""

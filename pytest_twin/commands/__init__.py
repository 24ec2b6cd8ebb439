"""Commands of the CLI. Each module has ``HELP``, ``add_arguments(parser)`` and ``run(args)``."""

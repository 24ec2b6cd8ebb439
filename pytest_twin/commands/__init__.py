"""One file per command; each has ``HELP``, ``add_arguments(parser)``, ``run(args) -> status``."""

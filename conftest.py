"""The project's own tests; the plugin itself is installed as an entry point."""

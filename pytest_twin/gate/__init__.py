"""The release gate: find stale goldens, run them, decide on a release, and sign it."""

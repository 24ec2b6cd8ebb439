"""What a change makes stale."""

"""What people read: failure texts, plots, the HTML report."""

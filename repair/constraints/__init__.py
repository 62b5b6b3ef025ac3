"""Safety constraints on actions, one per file."""

"""What a live bus does against its contract."""

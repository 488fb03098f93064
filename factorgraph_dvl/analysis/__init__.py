"""What trials and solutions say."""

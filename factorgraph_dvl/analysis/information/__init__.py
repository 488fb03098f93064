"""What the data of a trial can determine."""

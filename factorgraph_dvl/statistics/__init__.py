"""What residuals and information say of an estimate."""

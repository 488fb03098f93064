"""What a result is worth: findings, grades and the verdict, and all their texts."""

"""Results as JSON, CSV and YAML."""

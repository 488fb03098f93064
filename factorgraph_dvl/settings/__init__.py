"""YAML files as typed settings."""

"""Runs and sweeps: configuration, Ray actors, curriculum, evaluation, MLflow, tables, command lines."""

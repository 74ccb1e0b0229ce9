"""Stages for the worker of tests/hostile: the real ones, watched."""

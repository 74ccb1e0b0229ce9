"""The contracts that coordinator, workers and clients share: frozen pydantic models and nothing else."""

__version__ = "0.1.0"

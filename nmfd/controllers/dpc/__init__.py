"""Differentiable predictive control: policies, their files and training."""

"""Differentiable predictive control: policies, their training, and what watches over them."""

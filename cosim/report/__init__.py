"""Pictures, pages and films of finished and running simulations."""

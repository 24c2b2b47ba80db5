"""Terms of which f is the least: simulated, and differentiated."""

"""Studies of methods that need few simulations."""

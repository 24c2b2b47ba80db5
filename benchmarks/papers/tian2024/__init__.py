"""Tian, Fu, Zhang, Tang and Sun 2024: adaptive subset simulation for automated driving systems."""

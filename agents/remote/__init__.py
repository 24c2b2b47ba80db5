"""Egos in other processes and on other machines: client, server and protocol."""

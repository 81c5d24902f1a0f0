"""The controllers, each in a file of its own."""

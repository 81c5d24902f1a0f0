"""A live site: what a person asks for, its nodes kept up, and what is said of it."""

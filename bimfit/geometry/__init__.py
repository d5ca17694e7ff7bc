"""Poses, frames, profiles, slices: the nouns that every room shares."""

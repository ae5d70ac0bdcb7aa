"""Scenes with real detail: ornaments, thin structures, rough ground; what smooth bodies say nothing about."""

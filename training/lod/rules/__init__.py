"""The rules, one a module with its ``RULE``; found by ``lod.rule.rules``."""

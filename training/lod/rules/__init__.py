"""Level-of-detail rules, one per module as ``RULE``; ``lod.rule.rules`` discovers them."""

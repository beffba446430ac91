"""The physics measured against independent references: `palpate validate`. See the README for what is compared with what."""

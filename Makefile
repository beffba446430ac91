PY := .venv/bin/python
PACKAGES := bus models $(wildcard services/*) dashboards
EDITABLE := $(foreach p,$(PACKAGES),$(if $(wildcard $(p)/pyproject.toml),-e $(p)))

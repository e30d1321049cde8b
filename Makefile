# make demo   the whole way on a small rock: dataset, prior, three policies, table and pictures
# make test   lint, format, types, tests
# make docs   the documentation as a site, in site/
# They do all the set-up on their own (Python 3.11 or newer, libLLVM 19 or newer).

VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test docs results results-quick setup lock clean
.DEFAULT_GOAL := demo

demo: setup
	@$(BIN)/mgs demo

test: setup
	@echo "ruff check";  $(BIN)/ruff check -q .
	@echo "ruff format"; $(BIN)/ruff format -q --check .
	@echo "mypy";        $(BIN)/mypy --no-error-summary
	@echo "pytest";      $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart=0

# Not --quiet: it hides warnings from --strict. NO_MKDOCS_2_WARNING silences a notice about Material's successor.
docs: setup
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "wrote site/: open site/index.html (searching it needs a server: $(BIN)/python -m http.server --directory site)"

# Every number and picture of the pages anew: hours, and a repeated call continues. results-quick: eleven studies of one rock.
results: setup
	@$(BIN)/python -m studies.all out/results

results-quick: setup
	@$(BIN)/python -m studies.all out/results-quick --quick

setup: $(STAMP)

$(STAMP): pyproject.toml requirements.lock tools/setup.sh
	@sh tools/setup.sh $(VENV)
	@touch $@

# Resolve pyproject.toml anew and write requirements.lock.
lock:
	@sh tools/lock.sh

clean:
	rm -rf $(VENV) out demo site .mypy_cache .ruff_cache .pytest_cache

# Everything here sets itself up: Python 3.11 with pip and venv is all it takes.
PYTHON ?= python3
BIN = .venv/bin
READY = .venv/.ready
BENCH = PYTHONPATH=tests $(BIN)/python -m bench
# What sample_data/golden has.
GOLDEN = steering,depth,disparity

.PHONY: demo test lint sample regress fuzz figures presets gallery bench bench-accuracy bench-batch bench-drive \
	bench-map bench-objects own-motion check-trials torture sanitize goals coverage renew man clean help

demo: $(READY)  ## run the main job on sample_data
	$(BIN)/motionstereo run sample_data/left.mp4 sample_data/right.mp4 \
		--rig sample_data/rig.yaml --out out/demo --overwrite \
		--save report,preview
	@echo "Open out/demo/report.html in a browser. preview.mp4 plays anywhere; steering.csv has a row for each frame."

test: $(READY)  ## run the tests, on all cores
	$(BIN)/pytest -n auto --dist loadfile

lint: $(READY)  ## check style, types and spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell $(wildcard *.md .github .ci motionstereo_cli tests) Makefile pyproject.toml

# 40 frames of straight corridor, the turn to the left (40..64), and the straight after it. The golden
# record has no time: it would differ each time.
sample: $(READY)  ## render sample_data again, and what a run gives of it now
	$(BIN)/motionstereo simulate out/sample --overwrite --frames 310:410 --noise-sigma 1.5
	cp out/sample/left.mp4 out/sample/right.mp4 out/sample/rig.yaml sample_data/
	$(BIN)/motionstereo figure sample_data/left.mp4 sample_data/right.mp4 --rig sample_data/rig.yaml \
		--frames 20,54,72 --out sample_data/corridor.png
	$(BIN)/motionstereo run sample_data/left.mp4 sample_data/right.mp4 \
		--rig sample_data/rig.yaml --save $(GOLDEN) --out out/golden --overwrite
	rm -rf sample_data/golden
	mkdir -p sample_data/golden/depth sample_data/golden/disparity
	cp out/golden/steering.csv sample_data/golden/
	sed '/^  "timing": {$$/,/^  },$$/d' out/golden/run.json > sample_data/golden/run.json
	for image in depth/000020 depth/000054 depth/000072 disparity/000020 disparity/000072; do \
		cp out/golden/$$image.png sample_data/golden/$$image.png; done

regress: $(READY)  ## see that a run on sample_data gives what it gave before
	$(BIN)/motionstereo run sample_data/left.mp4 sample_data/right.mp4 \
		--rig sample_data/rig.yaml --save $(GOLDEN) --out out/regress --overwrite
	$(BIN)/motionstereo compare out/regress sample_data/golden \
		--junit out/regress.xml --picture out/regress.png

# Goes on from what reached new code in earlier nights, which is kept in out/fuzz.
FUZZ_SECONDS ?= 600
fuzz: $(READY)  ## try damaged files with each reader for FUZZ_SECONDS (10 minutes), and new examples
	$(BIN)/pytest tests/test_fuzz.py -s --fuzz-seconds $(FUZZ_SECONDS) \
		--fuzz-seed $$(($$(date +%s) / 86400))
	$(BIN)/pytest -n auto --dist loadfile --hypothesis-profile new

torture: $(READY)  ## damage input, kill runs, fill disks, run for long: half an hour
	$(BENCH) torture

# All tests that import what calls loops; a new one is among them by itself. Benchmarks and whole commands are slow.
LOOP_TESTS = $(filter-out tests/test_bench_% tests/test_hostile.py,$(shell grep -lP "motionstereo_cli\.(compiled|robot|method\.(?!settings))" tests/test_*.py))
SANITIZER = $(foreach name,asan ubsan stdc++,$(shell gcc -print-file-name=lib$(name).so))
sanitize: $(READY)  ## run the tests of the loops on loops that check each access to memory; Linux, gcc
	mkdir -p out
	$(BIN)/python -m motionstereo_cli.building.sanitize out/sanitize > out/sanitize.log 2>&1 \
		|| { cat out/sanitize.log; exit 1; }
	MOTIONSTEREO_LOOPS=$(CURDIR)/out/sanitize/motionstereo_cli/compiled LD_PRELOAD="$(SANITIZER)" \
	ASAN_OPTIONS=detect_leaks=0 PYTHONMALLOC=malloc \
		$(BIN)/pytest -n auto -p no:cacheprovider --capture=sys --durations=15 \
		-W error::pytest.PytestUnraisableExceptionWarning $(LOOP_TESTS)

# Coverage cannot see into compiled loops, so their tests run once more as plain Python.
coverage: $(READY)  ## measure which branches of the package the tests pass through
	$(BIN)/coverage erase
	$(BIN)/coverage run -m pytest
	MOTIONSTEREO_UNCOMPILED=1 $(BIN)/coverage run -m pytest tests/test_dense.py tests/test_matching.py \
		tests/test_stages.py -k "not TestUnits"
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report

own-motion: $(READY)  ## measure own motion and what moves by itself, and draw the street
	$(BENCH) own_motion --scenes "straight street" corridor street \
		--picture sample_data/own_charge.png
	$(BENCH) own_motion --walkers
	$(BENCH) own_motion --drives

figures: $(READY)  ## render the paper's figures 2 and 3
	$(BIN)/motionstereo simulate out/corridor --overwrite --frames 381 --noise-sigma 1.5
	$(BIN)/motionstereo figure out/corridor/left.mp4 out/corridor/right.mp4 --rig out/corridor/rig.yaml \
		--frames 350,355,360,365,370,375,380 --out out/figure2.png
	$(BIN)/motionstereo figure out/corridor/left.mp4 out/corridor/right.mp4 --rig out/corridor/rig.yaml \
		--frames 265,280,300,320,335,350 --out out/figure3.png

presets: $(READY)  ## draw what the presets make of the same frames, sample_data/presets.jpg
	$(BENCH) presets sample_data/presets.jpg

gallery: $(READY)  ## draw the stills of the gallery; RECORDINGS=folder for the recorded ones
	$(BENCH) gallery sample_data/gallery $(RECORDINGS)

bench: $(READY)  ## measure how fast everything is, against StereoBM and StereoSGBM
	$(BENCH) speed

bench-accuracy: $(READY)  ## measure how accurate the matchers are
	$(BENCH) accuracy

check-trials: $(READY)  ## try the command check on 20 simulated recordings, each good and spoilt
	$(BIN)/pytest tests/test_check.py -k trial --trials 20

bench-objects: $(READY)  ## measure how well moving things are followed
	$(BENCH) objects

bench-drive: $(READY)  ## let the robot find its way by different depths; resumes where it was
	$(BENCH) drive
	$(BENCH) drive --walkers 2

bench-map: $(READY)  ## measure how true the map of a drive is
	$(BENCH) map
	$(BENCH) map --walkers 2

goals: $(READY)  ## measure what tests/bench/goals.toml aims at, all of it or PART=house: prints reached or short
	$(BENCH) goals $(if $(PART),--part $(PART))

bench-batch: $(READY)  ## measure what a batch costs, and kill what works on it: 20 minutes
	$(BENCH) batch

man: $(READY)  ## write man pages to out/man
	$(BIN)/pip install --quiet click-man
	$(BIN)/click-man --target out/man motionstereo
	@echo "Read one with: man -l out/man/motionstereo-run.1"

help:  ## list all targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "%-16s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

renew: $(READY)  ## accept what the code gives now: the tables of the documentation and the sample
	$(BIN)/pytest tests/test_readme.py --renew
	$(MAKE) sample

clean:  ## remove everything that make made
	rm -rf .venv out build *.egg-info .coverage*

$(READY): pyproject.toml $(wildcard motionstereo_cli/compiled/*.py motionstereo_cli/compiled/*.h \
		motionstereo_cli/compiled/*.pxd)
	@echo "Installing into .venv, once: this compiles the inner loops in about a minute."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --disable-pip-version-check --editable ".[dev]"
	$(BIN)/python -m compileall -q motionstereo_cli  # many containers let no command do it
	touch $@

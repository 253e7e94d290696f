# Topological navigation, everything that docs/topological-results.md reports at one size, as a graph of its commands:
#
#   make -f benchmarks/topological.mk -j 8 RUNS=runs/topological-full            on a GPU machine (SIZE=full)
#   make -f benchmarks/topological.mk -j 2 SIZE=cpu RUNS=runs/topological-cpu    on two CPU cores
#   make -f benchmarks/topological.mk -j 8 SIZE=report RUNS=runs/report          the report's settings, ends in RUNS/tables.md
#   make -f benchmarks/topological.mk -j 16 SIZE=homes RUNS=runs/homes           generated homes of two tiers in SCENES
#   make -f benchmarks/topological.mk -n ...                                     only shows the commands
#
# What each command printed is in RUNS/log, how long it took in RUNS/times.txt. Interrupted, the same line goes on.
# PPO=RUN lets a run of `python -m train` (env.robot=ttbot) play the same episodes; SIZE=full trains one, RUNS/ppo.
# GPUS="0 1 2 3" spreads the commands over these.
# Not part of `all`: `renderer` (MuJoCo's renderer as the target; needs EGL or OSMesa), `scan` (SCAN=FOLDER, a converted room),
# `transfer-policy` and `renderer-policy` (the learned policy on the targets' maps), `batch` (thousands of episodes at once),
# `figures` (those of the report, for alder).

PY ?= python
SIZE ?= full
RUNS ?= runs/topological-$(SIZE)
GPUS ?=
SCAN ?=
SCENES ?= scenes_mjcf
SEEN = alder birch cedar elm hazel juniper linden maple
UNSEEN = rowan willow
ALL = $(SEEN) $(UNSEEN)

ifeq ($(SIZE),full)
  IMAGES =
  DATA = passage_sources=40
  MORE_POSITIONS = positions=600 max_per_room=40 passage_sources=1
  ROOMS = width=16 hidden=64 batch=128 learning_rate=1e-3 epochs=40
  ROOMS_MORE = width=16 hidden=64 batch=128 learning_rate=1e-3 epochs=12
  PASSAGES = width=16 batch=64 learning_rate=1e-3 epochs=60
  ALEXNET = width=16 batch=64 learning_rate=5e-4 epochs=60
  DRIVES = backend=native batch=3200
  POLICY = hidden=256 projection=128 learning_rate=1e-3 epochs=15
  GRID = $(POLICY) epochs=8
  MAP = check=60
  EVALUATION = backend=native limit_s=600
  SECONDARY = $(EVALUATION) episodes=25
  BATCH = backend=warp episodes=4000 batch=4000 limit_s=300 supersample=2
  FEATURES =
  PPO ?= $(RUNS)/ppo
  PPO_STEPS = 5_000_000
else ifeq ($(SIZE),cpu)
  IMAGES = width=64 height=48 supersample=2
  DATA = $(IMAGES) max_per_room=4 passage_sources=16
  MORE_POSITIONS = $(IMAGES) positions=300 max_per_room=8 passage_sources=1
  ROOMS = width=16 hidden=64 batch=64 learning_rate=1e-3 epochs=30
  ROOMS_MORE = width=16 hidden=64 batch=64 learning_rate=1e-3 epochs=15
  PASSAGES = width=16 batch=64 learning_rate=1e-3 epochs=30
  ALEXNET = width=16 batch=64 learning_rate=5e-4 epochs=30
  DRIVES = $(IMAGES) backend=native drives=50 batch=400
  POLICY = hidden=256 projection=128 learning_rate=1e-3 epochs=20
  GRID = $(POLICY)
  MAP = check=20
  EVALUATION = episodes=8 limit_s=600
  SECONDARY = episodes=4 limit_s=600
  BATCH = backend=native episodes=16 batch=16 limit_s=60
  FEATURES = epochs=4
  PPO ?=
  PPO_STEPS = 500_000
else ifeq ($(SIZE),report)
  # preset=report has the values. Eight homes for its ten and twenty, with as many drives; three homes test passages and
  # teach the detector nothing. Words of a command can be laid over it: MAP="preset=report check=5".
  DATA = preset=report
  PASSAGE_DATA = $(DATA) max_per_room=1 least_per_room=0
  TEST_SCENES = maple,rowan,willow
  ROOMS = preset=report
  PASSAGES = preset=report test_scenes=$(TEST_SCENES)
  ALEXNET = $(PASSAGES)
  DRIVES = preset=report backend=native drives=311 batch=311
  GRID = preset=report
  MAP = preset=report check=60
  EVALUATION = preset=report backend=native
  ADAPT = preset=report
  PAIRS = alpha-0.1-lambda-0.5 alpha-10-lambda-0.1 alpha-50-lambda-1
  PPO ?=
  DRIVEN_BY = $(RUNS)/policy-grid/alpha-10-lambda-0.1
  PASSAGES_FROM = data-passages
  LEARNED = dense,sparse
  BASELINE = --contenders dense$(if $(PPO),$(comma)ppo)
else ifeq ($(SIZE),homes)
  # 40 furnished and cluttered homes and the eight early ones to learn from, ten others to test: see docs/topological-homes.md.
  SCENES = runs/homes/scenes
  number = $(foreach tier,furnished cluttered,$(foreach n,$(1),$(tier)_0$(n)))
  TESTS = $(call number,20 21 22 23 24)
  SEEN := $(SEEN) $(call number,00 01 02 03 04 05 06 07 08 09 10 11 12 13 14 15 16 17 18 19)
  UNSEEN := $(TESTS)
  ALL = $(UNSEEN)
  DATA = passage_sources=20
  ROOMS = width=16 hidden=64 batch=128 learning_rate=1e-3 epochs=20
  PASSAGES = width=16 batch=64 learning_rate=1e-3 epochs=40
  DRIVES = backend=native drives=60 batch=60
  POLICY = hidden=256 projection=128 learning_rate=1e-3 epochs=15
  MAP = check=60
  EVALUATION = backend=native limit_s=600
else
  $(error SIZE is '$(SIZE)', expected full, cpu, report or homes)
endif
DRIVEN_BY ?= $(RUNS)/policy
PASSAGES_FROM ?= data
LEARNED ?= dense
# Whether homes are drawn and driven in by themselves.
APART := $(filter report homes,$(SIZE))
DRIVEN = $(if $(APART),$(SEEN:%=$(RUNS)/drives/%),$(RUNS)/drives)

NAV = $(PY) -m topological_nav
WITH = --localiser $(RUNS)/rooms --detector $(RUNS)/passages
folders = $(addprefix $(SCENES)/,$(1))
comma := ,
space := $() $()
log = $(RUNS)/log/$(notdir $@).txt
on_gpu = $(if $(GPUS),set -- $(GPUS); shift $$(( $$$$ % $(words $(GPUS)) )); export CUDA_VISIBLE_DEVICES=$$1;)
# $(call run,COMMAND): its output goes to the log, its seconds to times.txt; the target is touched when it is done.
run = @mkdir -p $(@D) $(RUNS)/log; echo "$(notdir $@): $(1)"; began=$$(date +%s); $(on_gpu) \
  if $(1) >>$(log) 2>&1; then echo "$(notdir $@) $$(( $$(date +%s) - began )) s" >>$(RUNS)/times.txt; touch $@; \
  else code=$$?; echo "$(notdir $@) failed ($$code): $(log)"; tail -n 3 $(log); exit $$code; fi

D = $(RUNS)/done
MAPS = $(ALL:%=$(D)/map-%)
.DEFAULT_GOAL := all
.PHONY: ladder hard all networks maps evaluation transfer transfer-policy renderer renderer-policy scan batch tables figures
ifeq ($(SIZE),homes)
all: ladder hard $(D)/export
networks: $(D)/rooms $(D)/passages
evaluation: $(D)/evaluation $(D)/evaluation-policy
$(D)/policy: $(D)/rooms $(D)/passages $(SEEN:%=$(D)/drives.%)
	$(call run,$(NAV) train policy --data $(DRIVEN) $(WITH) -o $(RUNS)/policy $(POLICY))
else ifeq ($(SIZE),report)
all: tables
networks: $(D)/rooms $(D)/rooms-up $(D)/rooms-down $(D)/passages $(D)/alexnet
evaluation: $(D)/evaluation $(D)/evaluation-policy
# An epoch in each home keeps the embeddings of its drives, for the three pairs, which learn side by side; the command for the
# grid finds them all, and adds up.
$(SEEN:%=$(D)/embedded.%): $(D)/embedded.%: $(D)/rooms $(D)/passages $(D)/drives.%
	$(call run,$(NAV) train policy --data $(RUNS)/drives/$* $(WITH) -o $(RUNS)/embedded/$* $(GRID) epochs=1)
$(PAIRS:%=$(D)/policy-grid.%): $(D)/policy-grid.%: $(SEEN:%=$(D)/embedded.%)
	$(call run,$(NAV) train policy --data $(DRIVEN) $(WITH) -o $(RUNS)/policy-grid/$* $(GRID) $(of_pair))
of_pair = alpha=$(word 2,$(subst -, ,$*)) lam=$(word 4,$(subst -, ,$*))
$(D)/policy-grid: $(PAIRS:%=$(D)/policy-grid.%)
$(D)/policy: $(D)/policy-grid.$(notdir $(DRIVEN_BY))
	@touch $@
else
all: networks maps $(D)/policy evaluation transfer $(D)/export
networks: $(D)/rooms $(D)/rooms-more $(D)/passages $(D)/alexnet
evaluation: $(D)/evaluation $(D)/evaluation-policy $(D)/evaluation-ahead1
$(D)/policy-grid: $(D)/policy
$(D)/policy: $(D)/rooms $(D)/passages $(D)/drives
	$(call run,$(NAV) train policy --data $(DRIVEN) $(WITH) -o $(RUNS)/policy $(POLICY))
endif
maps: $(MAPS)
tables: networks evaluation $(D)/policy-grid $(D)/adapted-passages
	$(NAV) tables $(RUNS)
figures: $(D)/drives$(if $(APART),.alder) $(D)/map-alder $(D)/policy $(D)/adapted-passages
	$(NAV) figures $(RUNS) $(WITH) --policy $(DRIVEN_BY) --maps $(RUNS)/maps $(EVALUATION)
transfer: $(D)/features $(D)/adapted-passages $(D)/evaluation-unadapted $(D)/evaluation-adapted
transfer-policy: $(D)/evaluation-unadapted-policy $(D)/evaluation-adapted-policy
batch: $(D)/evaluation-batch.cedar $(D)/evaluation-batch.rowan
renderer: $(D)/features-gl $(D)/adapted-passages-gl $(D)/evaluation-unadapted-gl $(D)/evaluation-adapted-gl
renderer-policy: $(D)/evaluation-unadapted-gl-policy $(D)/evaluation-adapted-gl-policy
scan: $(D)/features-scan $(D)/adapted-passages-scan $(D)/unadapted-map-scan $(D)/adapted-map-scan

ifneq ($(APART),)
# Each home by itself, many at a time; the command for all of them finds the images and numbers the rooms.
$(SEEN:%=$(D)/data.%): $(D)/data.%:
	$(call run,$(NAV) data $(SCENES)/$* -o $(RUNS)/parts/$* $(DATA))
$(D)/data: $(SEEN:%=$(D)/data.%)
	@mkdir -p $(RUNS)/data; mv $(foreach name,$(SEEN),$(RUNS)/parts/$(name)/$(name)) $(RUNS)/data
	$(call run,$(NAV) data $(call folders,$(SEEN)) -o $(RUNS)/data $(DATA))
$(SEEN:%=$(D)/drives.%): $(D)/drives.%:
	$(call run,$(NAV) data --drives $(SCENES)/$* -o $(RUNS)/drives/$* $(DRIVES))
else
$(D)/data:
	$(call run,$(NAV) data $(call folders,$(SEEN)) -o $(RUNS)/data $(DATA))
$(D)/drives:
	$(call run,$(NAV) data --drives $(call folders,$(SEEN)) -o $(RUNS)/drives $(DRIVES))
endif
$(D)/data-more:
	$(call run,$(NAV) data $(call folders,$(SEEN)) -o $(RUNS)/data-more $(MORE_POSITIONS))
$(ALL:%=$(D)/passage-data.%): $(D)/passage-data.%:
	$(call run,$(NAV) data $(SCENES)/$* -o $(RUNS)/passage-parts/$* $(PASSAGE_DATA))
$(D)/data-passages: $(ALL:%=$(D)/passage-data.%)
	@mkdir -p $(RUNS)/data-passages; mv $(foreach name,$(ALL),$(RUNS)/passage-parts/$(name)/$(name)) $(RUNS)/data-passages
	$(call run,$(NAV) data $(call folders,$(ALL)) -o $(RUNS)/data-passages $(PASSAGE_DATA))

$(D)/rooms: $(D)/data
	$(call run,$(NAV) train rooms --data $(RUNS)/data -o $(RUNS)/rooms $(ROOMS))
$(D)/rooms-more: $(D)/data-more
	$(call run,$(NAV) train rooms --data $(RUNS)/data-more -o $(RUNS)/rooms-more $(ROOMS_MORE))
$(D)/rooms-up $(D)/rooms-down: $(D)/rooms-%: $(D)/data
	$(call run,$(NAV) train rooms --data $(RUNS)/data -o $(RUNS)/rooms-$* $(ROOMS) pitch=$*)
$(D)/passages: $(D)/$(PASSAGES_FROM)
	$(call run,$(NAV) train passages --data $(RUNS)/$(PASSAGES_FROM) -o $(RUNS)/passages $(PASSAGES))
$(D)/alexnet: $(D)/$(PASSAGES_FROM)
	$(call run,$(NAV) train passages --data $(RUNS)/$(PASSAGES_FROM) -o $(RUNS)/alexnet network=alexnet $(ALEXNET))

$(D)/map-%: $(D)/rooms $(D)/passages
	$(call run,$(NAV) map $(SCENES)/$* $(WITH) -o $(RUNS)/maps/$*.npz $(MAP))
$(D)/policy-grid:
	$(call run,$(NAV) train policy --grid --data $(DRIVEN) $(WITH) -o $(RUNS)/policy-grid $(GRID))

$(D)/ppo:
	$(call run,$(PY) -m train --config turtlebot_ppo env.robot=ttbot "env.scenes=[$(subst $(space),$(comma),$(call folders,$(SEEN)))]" \
	  run.num_timesteps=$(PPO_STEPS) run.out_dir=$(RUNS) run.name=ppo)

# Scenes are played side by side (evaluation.alder, ...); the command for all of them then finds their rows, and adds up.
MAPS_OF = maps
played = $(NAV) evaluate $(1) --maps $(RUNS)/$(MAPS_OF) $(WITH) $(EVALUATION) -o $(RUNS)/$(basename $(notdir $@))
baseline = $(call played,$(1)) --policy passage $(BASELINE) $(if $(PPO),--ppo $(PPO))
learned = $(call played,$(1)) --contenders $(LEARNED) --policy $(DRIVEN_BY)
ahead1 = $(call played,$(1)) --contenders dense --policy passage ahead_m=1
each = $(patsubst %,$(D)/$(1).%,$(ALL))
$(call each,evaluation): $(D)/evaluation.%: $(D)/map-% $(if $(filter $(RUNS)/ppo,$(PPO)),$(D)/ppo)
	$(call run,$(call baseline,$(SCENES)/$*))
$(call each,evaluation-policy): $(D)/evaluation-policy.%: $(D)/map-% $(D)/policy
	$(call run,$(call learned,$(SCENES)/$*))
$(call each,evaluation-ahead1): $(D)/evaluation-ahead1.%: $(D)/map-%
	$(call run,$(call ahead1,$(SCENES)/$*))
$(D)/evaluation: $(call each,evaluation)
	$(call run,$(call baseline,$(call folders,$(ALL))))
$(D)/evaluation-policy: $(call each,evaluation-policy)
	$(call run,$(call learned,$(call folders,$(ALL))))
$(D)/evaluation-ahead1: $(call each,evaluation-ahead1)
	$(call run,$(call ahead1,$(call folders,$(ALL))))

# From the report's navigator (0) to ours (evaluation-policy), a setting at a time: images, matching, glances, watching, metres,
# retries, passages by length (up to 6, maps and navigator ask the detector for 2 m whatever an edge's length is), and slack.
$(ALL:%=$(D)/map-2m-%): $(D)/map-2m-%: $(D)/rooms $(D)/passages
	$(call run,$(NAV) map $(SCENES)/$* $(WITH) -o $(RUNS)/maps-2m/$*.npz $(MAP) asked_m=2)
images = $(if $(filter 0,$(1)),images=1 goal_images=1)
match = $(if $(filter 0 1,$(1)),match=nearest)
glance = $(if $(filter 0 1 2,$(1)),glance=false,$(if $(filter 3,$(1)),watch_s=0))
metres = $(if $(filter 0 1 2 3 4,$(1)),metre_cost=0)
retries = $(if $(filter 0 1 2 3 4 5,$(1)),retry_cost=0)
lengths = $(if $(filter 7,$(1)),slack_m=0,asked_m=2)
rung = $(foreach one,images match glance metres retries lengths,$(call $(one),$(1)))
STEPS = 0 1 2 3 4 5 6 7
define of_rung
$(ALL:%=$(D)/ladder-$(1).%): $(D)/ladder-$(1).%: $(D)/map-$(if $(filter 7,$(1)),,2m-)% $(D)/policy
	$$(call run,$(NAV) evaluate $(SCENES)/$$* --maps $(RUNS)/maps$(if $(filter 7,$(1)),,-2m) $(WITH) $(EVALUATION) --contenders dense --policy $(DRIVEN_BY) \
	  -o $(RUNS)/ladder-$(1) $(call rung,$(1)))
endef
$(foreach step,$(STEPS),$(eval $(call of_rung,$(step))))
ladder: $(foreach step,$(STEPS),$(ALL:%=$(D)/ladder-$(step).%)) $(call each,evaluation-policy)

# Small objects, and one of them in the narrowest place of the way: without metres, and where the robot pushes on (passable=0).
objects-10 = objects=10
objects-30 = objects=30
metres-0 = metre_cost=0 asked_m=2
$(call each,metres-0) $(call each,hard-metres-0): MAPS_OF = maps-2m
hard = objects=1 blocked=true
hard-metres-0 = $(hard) $(metres-0)
hard-push = $(hard) passable=0
VARIANTS = objects-10 objects-30 metres-0 hard hard-metres-0 hard-push
define of_variant
$(call each,$(1)): $(D)/$(1).%: $(D)/map-$(if $(findstring metres,$(1)),2m-)% $(D)/policy
	$$(call run,$$(call learned,$(SCENES)/$$*) $$($(1)))
endef
$(foreach variant,$(VARIANTS),$(eval $(call of_variant,$(variant))))
$(call each,hard-expert): $(D)/hard-expert.%:
	$(call run,$(NAV) evaluate $(SCENES)/$* --contenders expert $(EVALUATION) -o $(RUNS)/hard-expert $(hard))
hard: $(foreach variant,$(VARIANTS) hard-expert,$(call each,$(variant)))

# All episodes of a scene at once.
$(ALL:%=$(D)/evaluation-batch.%): $(D)/evaluation-batch.%: $(D)/map-% $(D)/policy
	$(call run,$(NAV) evaluate $(SCENES)/$* --maps $(RUNS)/maps $(WITH) --policy $(DRIVEN_BY) --contenders dense $(BATCH) \
	  -o $(RUNS)/evaluation-batch)

# Another camera: what the networks of the source see by it, and what adapting them brings. rowan and willow are new.
$(D)/features: $(D)/data $(D)/rooms
	$(call run,$(NAV) adapt features --data $(RUNS)/data --localiser $(RUNS)/rooms -o $(RUNS)/features $(FEATURES))
$(D)/data-unseen:
	$(call run,$(NAV) data $(call folders,$(UNSEEN)) -o $(RUNS)/data-unseen $(DATA))
$(D)/adapted-passages: $(D)/passages $(D)/data-unseen
	$(call run,$(NAV) adapt passages --target $(RUNS)/data-unseen --detector $(RUNS)/passages -o $(RUNS)/adapted-passages \
	  $(ADAPT))
ADAPTED = --localiser $(RUNS)/features --detector $(RUNS)/adapted-passages
$(D)/unadapted-map-%: $(D)/rooms $(D)/passages $(D)/data-unseen
	$(call run,$(NAV) adapt map $(SCENES)/$* --target $(RUNS)/data-unseen $(WITH) -o $(RUNS)/maps-unadapted/$*.npz)
$(D)/adapted-map-%: $(D)/features $(D)/adapted-passages
	$(call run,$(NAV) adapt map $(SCENES)/$* --target $(RUNS)/data-unseen $(ADAPTED) -o $(RUNS)/maps-adapted/$*.npz)
DRIVER = --policy $(DRIVEN_BY)
driven = $(NAV) evaluate $(call folders,$(UNSEEN)) --contenders dense$(1) -o $(RUNS)/$(notdir $@) $(SECONDARY)
$(D)/evaluation-unadapted: $(UNSEEN:%=$(D)/unadapted-map-%)
	$(call run,$(call driven, --domain camera) --maps $(RUNS)/maps-unadapted $(WITH))
$(D)/evaluation-adapted: $(UNSEEN:%=$(D)/adapted-map-%)
	$(call run,$(call driven, --domain camera) --maps $(RUNS)/maps-adapted $(ADAPTED))
$(D)/evaluation-unadapted-policy: $(UNSEEN:%=$(D)/unadapted-map-%) $(D)/policy
	$(call run,$(call driven, --domain camera) --maps $(RUNS)/maps-unadapted $(WITH) $(DRIVER))
$(D)/evaluation-adapted-policy: $(UNSEEN:%=$(D)/adapted-map-%) $(D)/policy
	$(call run,$(call driven, --domain camera) --maps $(RUNS)/maps-adapted $(ADAPTED) $(DRIVER))

# Targets that are datasets of their own, seen as they are: another renderer (gl), and a scanned room (scan). The dataset
# is the one that a target depends on; $(D)/data is named beside $(D)/rooms, because networks may come from elsewhere (-o).
seen = $(patsubst $(D)/%,--target $(RUNS)/%,$(filter $(D)/data-%,$^)) domain=clean
ADAPTED_TO = --localiser $(RUNS)/features-$(1) --detector $(RUNS)/adapted-passages-$(1)
$(D)/features-gl $(D)/features-scan: $(D)/features-%: $(D)/data $(D)/rooms $(D)/data-%
	$(call run,$(NAV) adapt features --data $(RUNS)/data --localiser $(RUNS)/rooms -o $(RUNS)/features-$* $(seen) $(FEATURES))
$(D)/adapted-passages-gl: $(D)/data-gl-unseen
$(D)/adapted-passages-scan: $(D)/data-scan-passages
$(D)/adapted-passages-gl $(D)/adapted-passages-scan: $(D)/passages
	$(call run,$(NAV) adapt passages --detector $(RUNS)/passages -o $(RUNS)/$(notdir $@) $(seen))

$(D)/data-gl:
	$(call run,$(NAV) data $(call folders,$(SEEN)) -o $(RUNS)/data-gl $(DATA) engine=gl)
$(D)/data-gl-unseen:
	$(call run,$(NAV) data $(call folders,$(UNSEEN)) -o $(RUNS)/data-gl-unseen $(DATA) engine=gl)
$(UNSEEN:%=$(D)/unadapted-map-gl-%): $(D)/unadapted-map-gl-%: $(D)/rooms $(D)/passages $(D)/data-gl-unseen
	$(call run,$(NAV) adapt map $(SCENES)/$* $(WITH) -o $(RUNS)/maps-unadapted-gl/$*.npz $(seen))
$(UNSEEN:%=$(D)/adapted-map-gl-%): $(D)/adapted-map-gl-%: $(D)/features-gl $(D)/adapted-passages-gl $(D)/data-gl-unseen
	$(call run,$(NAV) adapt map $(SCENES)/$* $(call ADAPTED_TO,gl) -o $(RUNS)/maps-adapted-gl/$*.npz $(seen))
$(D)/evaluation-unadapted-gl: $(UNSEEN:%=$(D)/unadapted-map-gl-%)
	$(call run,$(driven) --maps $(RUNS)/maps-unadapted-gl $(WITH))
$(D)/evaluation-adapted-gl: $(UNSEEN:%=$(D)/adapted-map-gl-%)
	$(call run,$(driven) --maps $(RUNS)/maps-adapted-gl $(call ADAPTED_TO,gl))
$(D)/evaluation-unadapted-gl-policy: $(UNSEEN:%=$(D)/unadapted-map-gl-%) $(D)/policy
	$(call run,$(driven) --maps $(RUNS)/maps-unadapted-gl $(WITH) $(DRIVER))
$(D)/evaluation-adapted-gl-policy: $(UNSEEN:%=$(D)/adapted-map-gl-%) $(D)/policy
	$(call run,$(driven) --maps $(RUNS)/maps-adapted-gl $(call ADAPTED_TO,gl) $(DRIVER))

# One room, too small for many ways of 2 m: passages are balanced and scored at 1 m.
scanned = $(or $(SCAN),$(error SCAN is not given, expected the folder of a converted scene: SCAN=FOLDER))
$(D)/data-scan:
	$(call run,$(NAV) data $(scanned) -o $(RUNS)/data-scan $(IMAGES) num_rooms=1 max_per_room=40 passage_sources=60)
$(D)/data-scan-passages:
	$(call run,$(NAV) data $(scanned) -o $(RUNS)/data-scan-passages $(IMAGES) num_rooms=1 max_per_room=2 \
	  passage_sources=80 passage_length_m=1.0 test_share=0.3)
$(D)/unadapted-map-scan: $(D)/rooms $(D)/passages $(D)/data-scan
	$(call run,$(NAV) adapt map $(scanned) $(WITH) -o $(RUNS)/maps-unadapted-scan/scan.npz $(seen))
$(D)/adapted-map-scan: $(D)/features-scan $(D)/adapted-passages-scan $(D)/data-scan
	$(call run,$(NAV) adapt map $(scanned) $(call ADAPTED_TO,scan) -o $(RUNS)/maps-adapted-scan/scan.npz $(seen))

$(D)/export: $(D)/rooms $(D)/passages $(D)/policy
	$(call run,$(NAV) export $(WITH) --policy $(RUNS)/policy --images $(RUNS)/data -o $(RUNS)/export)

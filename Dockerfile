# On a CPU:  docker build -t interactive-nav . && docker run --rm -v "$PWD:/work" interactive-nav demo
# On a GPU:  docker build --build-arg EXTRA=gpu -t interactive-nav:gpu . && docker run --rm --gpus all -v "$PWD:/work" interactive-nav:gpu \
#              train --config turtlebot_ppo_images
# JAX's wheels bring CUDA, so that one base image serves both; the host needs NVIDIA's driver and container toolkit.
FROM python:3.12-slim-bookworm
ARG EXTRA=view
COPY . /src
RUN pip install --no-cache-dir "/src[$EXTRA]"
WORKDIR /work
# Half of a GPU's memory is left to Warp, which allocates beside JAX.
ENV XLA_PYTHON_CLIENT_MEM_FRACTION=0.5
ENTRYPOINT ["interactive-nav"]
CMD ["--help"]

# rare-envs in a container; the run's folder is left in ./runs:
#   mkdir -p runs && docker build -t rare-envs .
#   docker run --rm -v "$PWD/runs:/data/runs" rare-envs estimate rare_envs/CutIn-v0 --out runs/cutin
# The container's user has the number 1000; where yours (id -u) is another one: --build-arg USER_ID="$(id -u)" to build.
FROM python:3.11-slim AS build
WORKDIR /source
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.11-slim
COPY constraints.txt /tmp/constraints.txt
COPY --from=build /wheels /wheels
# The CPU build of torch is a tenth of the size of the CUDA build; give another index for a GPU.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --index-url "$TORCH_INDEX" "$(grep '^torch==' /tmp/constraints.txt)" \
    && pip install --no-cache-dir -c /tmp/constraints.txt "$(ls /wheels/*.whl)[driving]" \
    && rm -r /wheels /tmp/constraints.txt
ARG USER_ID=1000
RUN useradd --uid "$USER_ID" --create-home user && mkdir -p /data/runs && chown -R user /data
USER $USER_ID
WORKDIR /data
ENTRYPOINT ["rare-envs"]
CMD ["--help"]

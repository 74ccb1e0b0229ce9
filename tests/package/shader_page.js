// Runs one probe program (shader_probes.py) in WebGL2 or WebGPU and returns its numbers as base64 of float32 [rows, points, 4].
// `job`: { code, points, rows, columns, inputs, textures: { name: { dimension, width, height, layers, levels } } }, bytes as
// base64, textures RGBA16F.

const bytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));

function base64(data) {
  let text = "";
  const all = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
  for (let at = 0; at < all.length; at += 32768) text += String.fromCharCode(...all.subarray(at, at + 32768));
  return btoa(text);
}

// WebGL2: a fragment shader over points x rows pixels of floats.
window.runGlsl = (job) => {
  const gl = new OffscreenCanvas(1, 1).getContext("webgl2");
  if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 cannot draw floats here");
  const program = gl.createProgram();
  const vertex = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.0, 1.0); }`;
  for (const [type, code] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, job.code]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, code);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);

  let unit = 0;
  const bind = (name, target, filter) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(target, gl.createTexture());
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.uniform1i(gl.getUniformLocation(program, name), unit++);
  };
  bind("tInputs", gl.TEXTURE_2D, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  const inputs = new Float32Array(bytes(job.inputs).buffer);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, job.columns, job.points, 0, gl.RGBA, gl.FLOAT, inputs);
  for (const [name, { dimension, width, height, layers, levels }] of Object.entries(job.textures)) {
    const target = { "2d": gl.TEXTURE_2D, "2d-array": gl.TEXTURE_2D_ARRAY, cube: gl.TEXTURE_CUBE_MAP }[dimension];
    bind(name, target, gl.LINEAR);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(target, gl.TEXTURE_MAX_LEVEL, levels.length - 1);
    levels.forEach((level, mip) => {
      const data = new Uint16Array(bytes(level).buffer);
      const [w, h] = [width >> mip, height >> mip];
      const faces = dimension === "cube" ? layers : 1;
      for (let face = 0; face < faces; face++) {
        const part = data.subarray((face * data.length) / faces, ((face + 1) * data.length) / faces);
        const into = dimension === "cube" ? gl.TEXTURE_CUBE_MAP_POSITIVE_X + face : target;
        const rest = [0, gl.RGBA, gl.HALF_FLOAT, part];
        if (dimension === "2d-array") gl.texImage3D(into, mip, gl.RGBA16F, w, h, layers, ...rest);
        else gl.texImage2D(into, mip, gl.RGBA16F, w, h, ...rest);
      }
    });
  }

  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  const target = gl.createRenderbuffer();
  gl.bindRenderbuffer(gl.RENDERBUFFER, target);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA32F, job.points, job.rows);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
  gl.viewport(0, 0, job.points, job.rows);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const results = new Float32Array(job.points * job.rows * 4);
  gl.readPixels(0, 0, job.points, job.rows, gl.RGBA, gl.FLOAT, results);
  if (gl.getError() !== gl.NO_ERROR) throw new Error("WebGL2 reports an error");
  gl.getExtension("WEBGL_lose_context").loseContext();
  return base64(results);
};

// A WebGPU device and a module that it compiled without a warning.
async function compiled(code) {
  const adapter = await navigator.gpu?.requestAdapter();
  if (!adapter) throw new Error("no WebGPU adapter here");
  const device = await adapter.requestDevice();
  const module = device.createShaderModule({ code });
  const faults = (await module.getCompilationInfo()).messages.map(({ lineNum, message }) => `${lineNum}: ${message}`);
  if (faults.length) throw new Error(faults.join("\n"));
  return { device, module };
}

// Throws unless a program makes a pipeline with the vertices of surface.wgsl.
window.checkExample = async (code) => {
  const { device, module } = await compiled(code);
  const formats = "float32x3 float32x3 float32x2 float32x2 float32x4 float32x2 float32x2 float32x4".split(" ");
  const offsets = [0, 12, 24, 32, 40, 56, 64, 72];
  const attributes = formats.map((format, k) => ({ format, shaderLocation: k, offset: offsets[k] }));
  await device.createRenderPipelineAsync({
    layout: "auto",
    vertex: { module, buffers: [{ arrayStride: 88, attributes }] },
    fragment: { module, targets: [{ format: "rgba16float" }] },
  });
  device.destroy();
};

// WebGPU: a compute shader over points and rows.
window.runWgsl = async (job) => {
  const { device, module } = await compiled(job.code);
  const pipeline = await device.createComputePipelineAsync({ layout: "auto", compute: { module } });
  const storage = (size, usage) => device.createBuffer({ size, usage: usage | GPUBufferUsage.STORAGE });
  const inputs = storage(job.points * job.columns * 16, GPUBufferUsage.COPY_DST);
  device.queue.writeBuffer(inputs, 0, bytes(job.inputs));
  const results = storage(job.points * job.rows * 16, GPUBufferUsage.COPY_SRC);
  const views = Object.values(job.textures).map(({ dimension, width, height, layers, levels }) => {
    const texture = device.createTexture({
      size: [width, height, layers],
      mipLevelCount: levels.length,
      format: "rgba16float",
      usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST,
    });
    levels.forEach((level, mipLevel) => {
      const [w, h] = [width >> mipLevel, height >> mipLevel];
      const layout = { bytesPerRow: w * 8, rowsPerImage: h };
      device.queue.writeTexture({ texture, mipLevel }, bytes(level), layout, [w, h, layers]);
    });
    return texture.createView({ dimension });
  });
  const sampler = device.createSampler({ magFilter: "linear", minFilter: "linear", mipmapFilter: "linear" });
  const resources = [{ buffer: inputs }, { buffer: results }, sampler, ...views];
  const group = device.createBindGroup({
    layout: pipeline.getBindGroupLayout(0),
    entries: resources.map((resource, binding) => ({ binding, resource })),
  });
  const encoder = device.createCommandEncoder();
  const pass = encoder.beginComputePass();
  pass.setPipeline(pipeline);
  pass.setBindGroup(0, group);
  pass.dispatchWorkgroups(job.points / 64, job.rows);
  pass.end();
  const read = device.createBuffer({ size: results.size, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
  encoder.copyBufferToBuffer(results, 0, read, 0, results.size);
  device.queue.submit([encoder.finish()]);
  await read.mapAsync(GPUMapMode.READ);
  const text = base64(new Float32Array(read.getMappedRange()));
  device.destroy();
  return text;
};

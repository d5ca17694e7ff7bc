"use strict";
// Turns a gap mesh and the edges of its elements on a canvas: WebGL 2, no library, nothing from the network.
(() => {
  const decode = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const VERTEX = `#version 300 es
    uniform mat3 turn; uniform vec3 scale; uniform vec2 shift;
    in vec3 place; in vec3 colour; out vec3 at; out vec3 paint;
    void main() { at = turn * place; paint = colour;
      gl_Position = vec4(at.xy * scale.xy + shift, -at.z * scale.z, 1.0); }`;
  const FRAGMENT = `#version 300 es
    precision highp float; uniform bool lit; in vec3 at; in vec3 paint; out vec4 result;
    void main() { float light = 1.0;
      if (lit) { vec3 n = normalize(cross(dFdx(at), dFdy(at))); light = 0.55 + 0.45 * abs(n.z); }
      result = vec4(paint * light, 1.0); }`;

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return gl.getProgramParameter(made, gl.LINK_STATUS) ? made : null;
  }

  function attribute(gl, shader, name, data, kind, normalised) {
    const where = gl.getAttribLocation(shader, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, 3, kind, normalised, 0, 0);
  }

  function setUp(canvas) {
    const model = JSON.parse(canvas.dataset.model);
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
    const shader = gl && program(gl);
    if (!shader) { canvas.closest("figure").hidden = true; return; }
    gl.useProgram(shader);
    gl.enable(gl.DEPTH_TEST);
    const faces = new Uint32Array(decode(model.faces)), lines = new Float32Array(decode(model.lines));
    const solid = gl.createVertexArray(), wire = gl.createVertexArray();
    gl.bindVertexArray(solid);
    attribute(gl, shader, "place", new Float32Array(decode(model.vertices)), gl.FLOAT, false);
    attribute(gl, shader, "colour", new Uint8Array(decode(model.colours)), gl.UNSIGNED_BYTE, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(wire);
    attribute(gl, shader, "place", lines, gl.FLOAT, false);
    gl.disableVertexAttribArray(gl.getAttribLocation(shader, "colour"));
    const view = { yaw: model.yaw, pitch: -0.9, zoom: model.fit, x: 0, y: 0 };
    const [gx, gz] = [model.radius, model.reach];

    function draw() {
      const ratio = window.devicePixelRatio || 1;
      canvas.width = canvas.clientWidth * ratio;
      canvas.height = canvas.clientHeight * ratio;
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
      const turn = [cy, cp * sy, sp * sy, -sy, cp * cy, sp * cy, 0, -sp, cp];
      const aspect = canvas.width / canvas.height, size = 0.9 * view.zoom / gx;
      const across = aspect > 1 ? size / aspect * Math.min(aspect, 1.6) : size;
      const put = (name) => gl.getUniformLocation(shader, name);
      gl.uniformMatrix3fv(put("turn"), false, turn);
      gl.uniform3f(put("scale"), across, across * aspect, 0.5 / gz);
      gl.uniform2f(put("shift"), view.x, view.y);
      gl.bindVertexArray(solid);
      gl.uniform1i(put("lit"), 1);
      gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
      gl.bindVertexArray(wire);
      gl.uniform1i(put("lit"), 0);
      gl.vertexAttrib3f(gl.getAttribLocation(shader, "colour"), 0.48, 0.53, 0.58);
      gl.drawArrays(gl.LINES, 0, lines.length / 3);
    }

    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      if (event.shiftKey || event.buttons === 2) {
        view.x += 2 * event.movementX / canvas.clientWidth;
        view.y -= 2 * event.movementY / canvas.clientHeight;
      } else {
        view.yaw += 0.008 * event.movementX;
        view.pitch = Math.max(-Math.PI, Math.min(0, view.pitch + 0.008 * event.movementY));
      }
      draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.zoom = Math.max(0.1, Math.min(200, view.zoom * Math.exp(-0.0015 * event.deltaY)));
      draw();
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    window.addEventListener("resize", draw);
    draw();
  }

  document.querySelectorAll("canvas.gap").forEach(setUp);
})();

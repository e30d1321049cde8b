// Pictures of a file of Gaussians by two viewers, as data URLs. projection, pose: 16 numbers of the
// matrices of OpenGL, column by column; pose is camera to world.

// Picture once it differs from the one before `show` and has not changed for two seconds: splats are
// sorted beside the drawing.
async function settled(canvas, show) {
  const blank = canvas.toDataURL();
  let last = blank;
  show();
  for (let same = 0; same < 4; ) {
    await new Promise((done) => setTimeout(done, 500));
    const next = canvas.toDataURL();
    same = next === last && next !== blank ? same + 1 : 0;
    last = next;
  }
  return last;
}

export async function spark(file, width, height, projection, pose) {
  const THREE = await import('three');
  const { SparkRenderer, SplatMesh } = await import('@sparkjsdev/spark');
  const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(width, height);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
  new THREE.Matrix4().fromArray(pose).decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld();
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  const drawer = new SparkRenderer({ renderer }), mesh = new SplatMesh({ url: file });
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  await mesh.initialized;
  return settled(renderer.domElement, () => scene.add(drawer, mesh));
}

export async function playcanvas(file, width, height, projection, pose) {
  const pc = await import('playcanvas');
  const canvas = document.body.appendChild(document.createElement('canvas'));
  const graphicsDeviceOptions = { antialias: false, alpha: false, preserveDrawingBuffer: true };
  const app = new pc.Application(canvas, { graphicsDeviceOptions });
  app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  app.start();
  // As 3DGS: antialiased, none too small, widened by 0.3 square pixels instead of 0.3 / 4, and
  // without the lowered tail of each Gaussian.
  Object.assign(app.scene.gsplat, { antiAlias: true, minPixelSize: 0 });
  const chunks = pc.ShaderChunks.get(app.graphicsDevice, pc.SHADERLANGUAGE_GLSL);
  for (const [name, old, constant] of [
    ['gsplatCornerVS', '0.3', '1.2'],
    ['gsplatPS', '(exp(x * -4.0) - EXP4) * INV_EXP4', 'exp(x * -4.0)'],
  ]) {
    if (!chunks.get(name).includes(old)) throw Error(`${name} of this PlayCanvas has no ${old}`);
    chunks.set(name, chunks.get(name).replaceAll(old, constant));
  }
  const camera = new pc.Entity(), matrix = new pc.Mat4().set(pose);
  camera.addComponent('camera', { clearColor: pc.Color.BLACK, toneMapping: pc.TONEMAP_NONE });
  camera.camera.calculateProjection = (target) => target.set(projection);
  camera.setPosition(matrix.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(matrix));
  app.root.addChild(camera);
  const scene = file.endsWith('.glb');
  const asset = new pc.Asset(file, scene ? 'container' : 'gsplat', { url: file });
  app.assets.add(asset);
  await new Promise((done, wrong) => {
    asset.ready(done);
    asset.on('error', wrong);
    app.assets.load(asset);
  });
  const model = scene ? asset.resource.instantiateRenderEntity() : new pc.Entity();
  if (!scene) model.addComponent('gsplat', { asset });
  return settled(canvas, () => app.root.addChild(model));
}

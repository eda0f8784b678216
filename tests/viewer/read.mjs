// Reads a glTF file with three.js and prints the attributes of its first primitive as JSON.
import { readFileSync } from 'node:fs';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';

const bytes = readFileSync(process.argv[2]);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new Promise((resolve, reject) => new GLTFLoader().parse(buffer, '', resolve, reject));
let points;
gltf.scene.traverse((object) => { points ??= object.isPoints ? object : undefined; });
const attributes = Object.entries(points.geometry.attributes).map(([name, { itemSize, array }]) => [name, { itemSize, array: [...array] }]);
const { mode, extensions } = gltf.parser.json.meshes[0].primitives[0];
console.log(JSON.stringify({ mode, extensions, attributes: Object.fromEntries(attributes) }));
